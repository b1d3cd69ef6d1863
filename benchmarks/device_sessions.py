"""A device that calibrates itself over its life.

python -m benchmarks.device_sessions [--seed=1] [--sessions=10] [--keypoints=80] [--seconds=120]

A simulated device whose calibration is wrong (focal length 5 px, centre 4 px, mounting 1 deg and 1 cm, scales
of the IMU 1 %) is carried through a room for sessions of two minutes. Each is read as a user types it, with
`rovioli --self_calibrate --sc_apply=next_start`; keypoints are simulated, not images. The last is also read
with the first and the true calibration. At the end the calibration on the kept segments is compared with the
truth, and with that on segments of the saved maps. A session takes a minute of processor time; sessions that
are there already are not read again.
"""

from __future__ import annotations

import argparse
import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np

from benchmarks.frontend.sequences import position_errors
from maplab_py.algorithms.self_calibration.calibration import calibrate
from maplab_py.algorithms.self_calibration.device import transfer_calibration
from maplab_py.algorithms.self_calibration.segments.database import SegmentDatabase, load_database
from maplab_py.algorithms.self_calibration.segments.selection import collect
from maplab_py.array_types import F64
from maplab_py.estimation.blocks import ParameterBlocks
from maplab_py.interop.trajectories import Trajectory, read_trajectory
from maplab_py.sensors import SensorSet
from maplab_py.simulation.scenario import (
    CalibrationOptions,
    MotionOptions,
    Scenario,
    SessionOptions,
)
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.truth import true_map
from maplab_py.storage.native import load_map, save_map
from maplab_py.vimap import excerpts
from studies.data_sets import OPTIONS, data_set, true_problem

_DEG = float(np.pi / 180.0)


def scenarios(seed: int, keypoints: int, seconds: float) -> tuple[Scenario, Scenario]:
    """Return the device as its calibration says, and as it is."""
    plain = load_scenario("ar_room").with_seed(seed)
    measurement = dataclasses.replace(plain.measurement, max_keypoints=keypoints)
    calm = MotionOptions(
        kind="room_scan",
        duration_s=0.4 * seconds,
        turns=0.005 * seconds,
        height_m=1.4,
        shake_m=0.02,
    )
    phases = (
        calm,
        dataclasses.replace(calm, kind="figure_8"),
        dataclasses.replace(calm, duration_s=0.2 * seconds, turns=0.1, shake_m=0.06, shake_rad=0.2),
    )
    plain = dataclasses.replace(
        plain, calibration=CalibrationOptions(), measurement=measurement,
        sessions=(SessionOptions(phases=phases),),
    )  # fmt: skip
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


def _error_mm(truth: Trajectory, source: Path, poses: Path, more: str = "") -> tuple[float, str]:
    """Read a session; return the position error after SE(3) alignment, and the last words of the run."""
    line = f"rovioli {source} --export_estimated_poses_to_csv={poses} {more}"
    said = poses.with_suffix(".txt")
    if not said.exists():
        done = subprocess.run(
            [sys.executable, "-m", "maplab_py", "--discard", "-c", line],
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        if done.returncode:
            sys.exit(done.stdout + done.stderr)
        said.write_text(done.stdout)
    estimated = read_trajectory(poses)
    errors, _ = position_errors(truth, estimated.times_ns, estimated.T_R_B)
    lines = (each.strip() for each in said.read_text().splitlines())
    words = [each for each in lines if "contradicted" in each or each.startswith("self-cal")]
    return 1e3 * float(np.sqrt(np.mean(errors**2))), "; ".join(words)


def run(given: argparse.Namespace) -> None:
    """Read the sessions one after another, and compare; or only read one."""
    folder, sessions, only = given.out, given.sessions, given.only
    folder.mkdir(parents=True, exist_ok=True)
    nominal, device = scenarios(given.seed, given.keypoints, given.seconds)
    sensors = data_set(nominal, 0).maps[0].sensors
    database, truth_blocks = folder / "device.segments", None
    flags = f"--self_calibrate --sc_database={database} --sc_apply=next_start"
    first_mm = 0.0
    for number in range(only - 1, only) if only else range(sessions):
        data = data_set(device, number)
        right = true_map(data.maps[0], data.truth)
        truth = Trajectory(right.vertices.timestamp_ns, right.T_G_I)
        truth_blocks = truth_blocks or true_problem(data).states.blocks
        source, best, out = (folder / f"{name}_{number}" for name in ("given", "true", "map"))
        if not source.exists():
            save_map(data.maps[0].replace(sensors=sensors), source)
            save_map(data.maps[0].replace(sensors=right.sensors), best)
        size_mm, words = _error_mm(
            truth, source, folder / f"device_{number}.csv", f"{flags} --save_map_folder={out}"
        )
        first_mm = first_mm or size_mm
        print(f"session {number + 1}: {size_mm:.1f} mm; {words}", flush=True)
        if number == sessions - 1:
            nominal_mm, _ = _error_mm(truth, source, folder / f"nominal_{number}.csv")
            true_mm, _ = _error_mm(truth, best, folder / f"true_{number}.csv")
            print(f"  first calibration {nominal_mm:.1f} mm, true one {true_mm:.1f} mm; over "
                  f"session 1 {size_mm / first_mm:.2f}", flush=True)  # fmt: skip
    if truth_blocks is None or only:
        return
    of_maps = None
    for number in range(sessions):
        # all sessions begin at the same time, from which ids of missions follow
        vi_map = excerpts.with_ids_of_times(load_map(folder / f"map_{number}")[0], f"{number}")
        vi_map = transfer_calibration(vi_map, sensors)
        of_maps, _ = collect(vi_map, OPTIONS, of_maps)
    assert of_maps is not None
    beside = _judged("beside the odometry", load_database(database), sensors, truth_blocks)
    maps = _judged("saved maps", of_maps, sensors, truth_blocks)
    ratio, apart = (np.linalg.norm(x) / np.linalg.norm(maps) for x in (beside, beside - maps))
    print(f"{ratio:.2f} of the error on saved maps, apart by {apart:.2f} of it")


def _judged(name: str, kept: SegmentDatabase, sensors: SensorSet, truth: ParameterBlocks) -> F64:
    """Print error and consistency of the calibration on segments; return its error in units of the priors."""
    result, _ = calibrate(transfer_calibration(kept.vi_map, sensors), OPTIONS)
    error, start = (
        result.parameters.difference(blocks, truth) for blocks in (result.blocks, result.before)
    )
    nees = float(error @ np.linalg.solve(result.uncertainty.formal, error)) / len(error)
    of_prior, at_first = (each / result.parameters.prior_sigma for each in (error, start))
    print(
        f"{name}: {len(kept)} segments, error {np.sqrt(np.mean(of_prior**2)):.4f} of the priors (at first "
        f"{np.sqrt(np.mean(at_first**2)):.4f}), NEES / dimension {nees:.2f}",
        flush=True,
    )
    return of_prior


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--sessions", type=int, default=10)
    parser.add_argument("--only", type=int, default=0, help="session to read now, from 1")
    parser.add_argument("--keypoints", type=int, default=80)
    parser.add_argument("--seconds", type=float, default=120.0, help="length of a session")
    parser.add_argument("--out", type=Path, default=Path("device_sessions"))
    arguments = parser.parse_args()
    run(arguments)


if __name__ == "__main__":
    main()
