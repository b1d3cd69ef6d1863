"""Sensors that fail in the middle of a recording.

python -m benchmarks.sensor_failures [FOLDER] [--seeds=3] [--cameras=0] [--first_s=4.5] [--unwatched]

Twelve kinds of failures, or those with the words --kinds, are planted into a recording (EuRoC MH_01 with both
cameras, or a folder), each seed at another time from --first_s on; cameras take turns. A line a run: what was
found after how many seconds, and the largest distance to the trajectory of the whole recording; --unwatched:
that distance without a watch. A success is found within 3 s, and stays within 10 cm or ends with a reason.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from maplab_py.errors import MaplabError
from maplab_py.frontend.failures.watch import SensorWatch
from maplab_py.frontend.mapping import Mapping
from maplab_py.frontend.run_options import OutputOptions, RunOptions
from maplab_py.interop.recordings.options import SourceOptions
from maplab_py.interop.recordings.protocol import Recording
from maplab_py.interop.recordings.reader_choice import open_recording
from maplab_py.interop.trajectories import Trajectory
from tests.frontend.failing import KINDS, failing
from tests.support.data import shared_data_folder

_STEP_S = 0.75
_FOUND_S, _NEAR_M = 3.0, 0.1
_OPTIONS = RunOptions(output=OutputOptions(run_map_builder=False))


def _run(recording: Recording) -> tuple[Mapping, str]:
    """Return a run, and the reason of its end if it failed."""
    mapping = Mapping(recording, _OPTIONS)
    try:
        mapping.run()
    except MaplabError as error:
        return mapping, str(error)
    return mapping, mapping.problem


def _distance_m(truth: Trajectory, mapping: Mapping) -> float:
    """Return the largest distance to a trajectory in the first mission's frame."""
    found = mapping.trajectory()
    rows = np.minimum(np.searchsorted(truth.times_ns, found.times_ns), len(truth.times_ns) - 1)
    same = truth.times_ns[rows] == found.times_ns
    away = found.T_R_B[same, 4:] - truth.T_R_B[rows[same], 4:]
    return float(np.linalg.norm(away, axis=1).max(initial=0.0))


def measure(
    recording: Recording, kind: str, seed: int, after_s: float, truth: Trajectory, zero_ns: int
) -> bool:
    """Plant a failure, print what has become of it; return whether it was a success."""
    from_ns = zero_ns + round(after_s * 1e9)
    camera = seed % len(recording.device.cameras)
    mapping, problem = _run(failing(recording, kind, from_ns, camera=camera))
    failures, sensor = mapping.odometry.watch.failures, kind.split(maxsplit=1)[0]
    late_s = min((1e-9 * (f.detected_ns - from_ns) for f in failures), default=float("nan"))
    is_right = bool(failures) and failures[0].sensor.startswith(sensor)
    away_m = _distance_m(truth, mapping)
    reasons = [start.reason for start in mapping.statistics.starts[1:]]
    is_survived = late_s <= _FOUND_S and (away_m < _NEAR_M or bool(problem or reasons))
    said = "; ".join(failure.words(zero_ns) for failure in failures[:2]) or "nothing"
    sys.stdout.write(
        f"{'good' if is_survived else 'BAD '} {kind} {seed}: after {late_s:.1f} s"
        f"{'' if is_right else ' (another sensor)'}, {100 * away_m:.1f} cm; {said}; {problem}{reasons}\n"
    )
    sys.stdout.flush()
    return is_survived


def _unwatched(recording: Recording, kind: str, from_ns: int, truth: Trajectory) -> float:
    """Return the distance when the odometry does not watch its sensors."""
    plain = SensorWatch.compare, SensorWatch.look, SensorWatch.usable
    SensorWatch.compare = lambda *_: None  # type: ignore[method-assign]
    SensorWatch.look = lambda *_, **__: None  # type: ignore[method-assign]
    SensorWatch.usable = lambda self, interval, smoother: (interval, self.failed)  # type: ignore[method-assign]
    try:
        return _distance_m(truth, _run(failing(recording, kind, from_ns))[0])
    finally:
        SensorWatch.compare, SensorWatch.look, SensorWatch.usable = plain  # type: ignore[method-assign]


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--cameras", default="")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--kinds", default="", help="those that contain these words")
    parser.add_argument("--first_s", type=float, default=4.5)
    parser.add_argument("--unwatched", action="store_true")
    arguments = parser.parse_args()
    folder = arguments.folder or shared_data_folder() / "euroc_mh01_10s"
    options = SourceOptions(rovio_active_camera_indices=arguments.cameras)
    whole, _ = _run(open_recording(folder, options))
    truth, zero_ns = whole.trajectory(), whole.statistics.first_ns
    alarms = [failure.words(zero_ns) for failure in whole.odometry.watch.failures]
    sys.stdout.write(f"unchanged: {alarms or 'nothing found'}\n")
    kinds, good = [kind for kind in KINDS if arguments.kinds in kind], 0
    for seed in range(arguments.seeds):
        after_s = arguments.first_s + _STEP_S * seed
        for kind in kinds:
            recording = open_recording(folder, options)
            if arguments.unwatched:
                away_m = _unwatched(recording, kind, zero_ns + round(after_s * 1e9), truth)
                sys.stdout.write(f"unwatched {kind}: {100 * away_m:.1f} cm\n")
                sys.stdout.flush()
                continue
            good += measure(recording, kind, seed, after_s, truth, zero_ns)
        if not arguments.unwatched:
            sys.stdout.write(f"good so far: {good} of {len(kinds) * (seed + 1)}\n")


if __name__ == "__main__":
    main()
