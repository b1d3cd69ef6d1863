"""Detection of a calibration that changes in the middle of a session.

python -m benchmarks.calibration_changes [--seeds 20] [--first_seed 1]

A simulated device walks for 28 s; then its camera turns on its mounting by 0.5 deg, its focal length or the
scale of its gyroscope changes by 1 %, or nothing, and it walks on for 32 s. The calibration is wrong by half
of the wanted deviations from the beginning. Segments have the states of the simulated odometry's drift. One
line a seed and change: when it was detected, as what.
"""

from __future__ import annotations

import argparse
import dataclasses

import numpy as np

from maplab_py.algorithms.self_calibration import changes
from maplab_py.algorithms.self_calibration.estimation.parameters import Parameters
from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.algorithms.self_calibration.pruning import estimate_segment
from maplab_py.algorithms.self_calibration.segments import splitting
from maplab_py.online_calibration.options import WantedSigmas
from maplab_py.online_calibration.suggestions import wanted_sigma
from maplab_py.simulation import scenario as sim
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import simulate
from maplab_py.vimap import VIMap

OPTIONS = SelfCalibrationOptions(keep_unobservable_at_prior=True)
CHANGES = ("none", "mounting", "focal length", "gyroscope scale")
_FIRST_AFTER = 7
"""Segment with which the change comes."""
_ALLOWED_S = 30.0


def scenario_of(seed: int, change: str) -> sim.Scenario:
    """Return a session with the change from its beginning."""
    phases = (
        sim.MotionOptions(kind="room_scan", duration_s=30.0, turns=0.5, height_m=1.4),
        sim.MotionOptions(kind="figure_8", duration_s=30.0, turns=0.5, height_m=1.4),
    )
    w = WantedSigmas()
    calibration = sim.CalibrationOptions(
        focal_sigma_px=0.5 * w.focal_relative * 255.0,
        centre_sigma_px=0.5 * w.centre_px,
        distortion_sigma=0.5 * w.distortion,
        camera_rotation_sigma_deg=0.5 * w.rotation_deg,
        camera_position_sigma_m=0.5 * w.position_m,
        gyro_scale_sigma=0.5 * w.imu,
        accel_scale_sigma=0.5 * w.imu,
        gyro_misalignment_sigma=0.5 * w.imu,
        accel_misalignment_sigma=0.5 * w.imu,
        accel_rotation_sigma_deg=0.5 * w.rotation_deg,
    )
    plain = load_scenario("ar_room").with_seed(seed)
    camera, imu = plain.cameras[0], plain.imu
    if change == "mounting":
        camera = dataclasses.replace(camera, turn_rad=(0.0, float(np.deg2rad(0.5)), 0.0))
    elif change == "focal length":
        f = 1.01 * camera.intrinsics[0]
        camera = dataclasses.replace(camera, intrinsics=(f, f, *camera.intrinsics[2:]))
    elif change == "gyroscope scale":
        imu = dataclasses.replace(imu, gyro_scale=(1.01, 1.01, 1.01))
    measurement = dataclasses.replace(plain.measurement, max_keypoints=100)
    sessions = (sim.SessionOptions(phases=phases),)
    return dataclasses.replace(
        plain, calibration=calibration, cameras=(camera,), imu=imu, sessions=sessions,
        measurement=measurement,
    )  # fmt: skip


class Watch:
    """Segments of one device, as the process beside the odometry sees them."""

    def __init__(self) -> None:
        """Start without segments."""
        self.evidence: list[changes.Evidence] = []
        self._parameters, self._tolerance = Parameters(()), np.zeros(0)

    def copy(self) -> Watch:
        """Return a watch that has seen the same."""
        other = Watch()
        other.evidence = list(self.evidence)
        other._parameters, other._tolerance = self._parameters, self._tolerance
        return other

    def add(self, segment: VIMap) -> changes.Contradiction | None:
        """Take a segment; return the strongest contradiction."""
        estimate, time_ns = estimate_segment(segment, OPTIONS), segment.vertices.timestamp_ns
        if not len(self._tolerance):
            self._parameters = estimate.parameters
            self._tolerance = wanted_sigma(segment, OPTIONS, WantedSigmas())
        if len(estimate.parameters) == len(self._parameters):
            self.evidence.append(changes.evidence_of(estimate, int(time_ns[0]), int(time_ns[-1])))
        return changes.strongest_contradiction(self.evidence, self._parameters, self._tolerance)


def measure(seed: int) -> dict[str, tuple[float, str]]:
    """Return for every change after how many seconds what was detected; nan = nothing."""
    plain, result = simulate(scenario_of(seed, "none")).maps[0], {}
    rows = splitting.split_into_segments(plain, None, OPTIONS.segment_keyframes)
    before, largest = Watch(), 0.0
    early = ""
    for of_segment in rows[:_FIRST_AFTER]:
        said = before.add(splitting.extract_submap(plain, of_segment))
        if said is not None:
            largest = max(largest, said.sigmas)
            early = said.family if said.is_significant else early
    changed_ns = int(plain.vertices.timestamp_ns[rows[_FIRST_AFTER][0]])
    for change in CHANGES:
        vi_map = plain
        if change != "none":
            vi_map = simulate(scenario_of(seed, change)).maps[0].replace(sensors=plain.sensors)
        watch, after_s, name = before.copy(), float("nan"), early and f"before: {early}"
        for of_segment in rows[_FIRST_AFTER:]:
            said = watch.add(splitting.extract_submap(vi_map, of_segment))
            if said is not None and change == "none":
                largest = max(largest, said.sigmas)
            if said is not None and said.is_significant:
                end_ns = int(vi_map.vertices.timestamp_ns[of_segment[-1]])
                after_s, name = 1e-9 * (end_ns - changed_ns), said.family
                break
        result[change] = after_s, name or f"at most {largest:.1f} sigma"
    return result


def main() -> None:
    """Print a line a seed and change, and counts at the end."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first_seed", type=int, default=1)
    arguments = parser.parse_args()
    counts = dict.fromkeys(CHANGES, 0)
    for seed in range(arguments.first_seed, arguments.first_seed + arguments.seeds):
        for change, (after_s, name) in measure(seed).items():
            counts[change] += after_s <= _ALLOWED_S
            print(f"seed {seed}: {change}: {after_s:.0f} s, {name}", flush=True)
        print(f"detected within {_ALLOWED_S:.0f} s so far: {counts}", flush=True)


if __name__ == "__main__":
    main()
