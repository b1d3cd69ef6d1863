"""A device that calibrates itself over its life.

python -m benchmarks.device_sessions [--seed=1] [--sessions=10] [--out=FOLDER]

A simulated device whose calibration is wrong (focal length 5 px, centre 4 px, mounting 1 deg and 1 cm, scales
of the IMU 1 %) records ten sessions of two minutes. Each is read as a user types it, with `rovioli
--self_calibrate --sc_apply=next_start`. A line a session has the position error, also with the first and the
true calibration. The calibration on the kept segments is compared with the truth, and with that on segments
of the saved maps.
"""

from __future__ import annotations

import argparse
import dataclasses
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from benchmarks.frontend.sequences import position_errors
from maplab_py.algorithms.self_calibration.calibration import calibrate
from maplab_py.algorithms.self_calibration.device import transfer_calibration
from maplab_py.algorithms.self_calibration.segments.database import load_database
from maplab_py.algorithms.self_calibration.segments.selection import collect
from maplab_py.interop.trajectories import Trajectory, read_trajectory
from maplab_py.simulation.scenario import CalibrationOptions, Scenario
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import SimulatedData
from maplab_py.simulation.truth import true_map
from maplab_py.storage.native import load_map, save_map
from maplab_py.vimap import VIMap
from studies.data_sets import OPTIONS, data_set, true_problem

SESSIONS = 10
_DEG = float(np.pi / 180.0)


def scenarios(seed: int) -> tuple[Scenario, Scenario]:
    """Return the device as its calibration says, and as it is."""
    plain = dataclasses.replace(
        load_scenario("ar_room").with_seed(seed), calibration=CalibrationOptions()
    )
    camera, imu = plain.cameras[0], plain.imu
    f, _, u, v = camera.intrinsics
    x, y, z = camera.position_m
    camera = dataclasses.replace(
        camera,
        intrinsics=(f + 5.0, f + 5.0, u + 4.0, v - 4.0),
        turn_rad=(0.6 * _DEG, -0.6 * _DEG, 0.5 * _DEG),
        position_m=(x + 0.006, y - 0.006, z + 0.005),
    )
    imu = dataclasses.replace(imu, gyro_scale=(1.01, 0.99, 1.01), accel_scale=(0.99, 1.01, 1.01))
    return plain, dataclasses.replace(plain, cameras=(camera,), imu=imu)


def _error(truth: Trajectory, poses: Path) -> float:
    """Return the root of the mean squared position error [m] after SE(3) alignment."""
    estimated = read_trajectory(poses)
    errors, _ = position_errors(truth, estimated.times_ns, estimated.T_R_B)
    return float(np.sqrt(np.mean(errors**2)))


def _truth(data: SimulatedData) -> tuple[Trajectory, VIMap]:
    right = true_map(data.maps[0], data.truth)
    return Trajectory(right.vertices.timestamp_ns, right.T_G_I), right


def _rovioli(arguments: str) -> str:
    line = [sys.executable, "-m", "maplab_py", "-c", f"rovioli {arguments}"]
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    return done.stdout + done.stderr


def run(seed: int, folder: Path, sessions: int = SESSIONS) -> None:
    """Read the sessions one after another, and compare."""
    folder.mkdir(parents=True, exist_ok=True)
    nominal, device = scenarios(seed)
    database, saved = folder / "device.segments", []
    sensors = data_set(nominal, 0).maps[0].sensors
    truth_blocks = None
    for number in range(sessions):
        data = data_set(device, number)
        truth, right = _truth(data)
        if truth_blocks is None:
            truth_blocks = true_problem(data).states.blocks
        given, best, out = (folder / f"{name}_{number}" for name in ("given", "true", "map"))
        save_map(data.maps[0].replace(sensors=sensors), given)
        save_map(data.maps[0].replace(sensors=right.sensors), best)
        errors = {}
        for name, source, more in (
            ("device", given, f"--self_calibrate --sc_database={database} --sc_apply=next_start "
                              f"--save_map_folder={out}"),
            ("nominal", given, ""),
            ("true", best, ""),
        ):  # fmt: skip
            poses = folder / f"poses_{name}_{number}.csv"
            began = time.perf_counter()
            said = _rovioli(f"{source} --export_estimated_poses_to_csv={poses} {more}")
            if not poses.exists():
                sys.stdout.write(said)
                return
            errors[name] = _error(truth, poses)
            if name == "device":
                notes = [s.strip() for s in said.splitlines() if "self-calibration:" in s]
                seconds = time.perf_counter() - began
        saved.append(load_map(out)[0])
        sys.stdout.write(
            f"session {number + 1}: {1e3 * errors['device']:.1f} mm, with the first calibration "
            f"{1e3 * errors['nominal']:.1f}, with the true one {1e3 * errors['true']:.1f}; "
            f"{seconds:.0f} s; {'; '.join(notes)}\n"
        )
        sys.stdout.flush()
        if number in (0, 1, 4, sessions - 1):
            _compare(database, saved, sensors, truth_blocks)


def _compare(database: Path, saved: list[VIMap], sensors: object, truth: object) -> None:
    """Print errors and consistency of the calibration on kept segments and on those of saved maps."""
    of_maps = None
    for vi_map in saved:
        plain = transfer_calibration(vi_map, sensors)  # type: ignore[arg-type]
        of_maps, _ = collect(plain, OPTIONS, of_maps)
    assert of_maps is not None
    results = {}
    for name, kept in (("beside the odometry", load_database(database)), ("saved maps", of_maps)):
        vi_map = transfer_calibration(kept.vi_map, sensors)  # type: ignore[arg-type]
        result, _ = calibrate(vi_map, OPTIONS)
        error = result.parameters.difference(result.blocks, truth)  # type: ignore[arg-type]
        sigma = np.sqrt(np.diag(result.uncertainty.formal))
        nees = float(error @ np.linalg.solve(result.uncertainty.formal, error))
        results[name] = error, result
        sys.stdout.write(
            f"  {name}: {len(kept)} segments, error {np.sqrt(np.mean((error / sigma) ** 2)):.2f} "
            f"sigma rms, NEES / dimension {nees / len(error):.2f}\n"
        )
    (one, result), (other, _) = results.values()
    prior = result.parameters.prior_sigma
    size = [float(np.sqrt(np.mean((each / prior) ** 2))) for each in (one, other, one - other)]
    start = result.parameters.difference(result.before, truth)  # type: ignore[arg-type]
    first = float(np.sqrt(np.mean((start / prior) ** 2)))
    sys.stdout.write(
        f"  errors in units of the priors: {size[0]:.4f} and {size[1]:.4f}, apart {size[2]:.4f}, "
        f"at first {first:.4f}\n"
    )
    sys.stdout.flush()


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--sessions", type=int, default=SESSIONS)
    parser.add_argument("--out", type=Path, default=Path("device_sessions"))
    arguments = parser.parse_args()
    run(arguments.seed, arguments.out, arguments.sessions)


if __name__ == "__main__":
    main()
