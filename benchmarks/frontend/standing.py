"""Drift while standing still for a minute: `python -m benchmarks.frontend.standing`.

A simulated rig walks for 8 s, stands for 60 s and walks on for 6 s. Keypoints have the noise of a tracker
that repeats itself at rest (0.15 px), or that of one that does not (0.8 px), so that tracks do not show
that it rests. Of the states as they were known at their time: the drift from the first to the last
second of the stop, the largest distance between two positions of it, and how often the odometry started.
"""

import argparse
import dataclasses
import json
from collections import Counter
from pathlib import Path

import numpy as np
from scipy.spatial.distance import pdist

from maplab_py.frontend.odometry import Odometry
from maplab_py.interop.recordings.map_replay import MapRecording
from maplab_py.interop.recordings.protocol import ImuBatch, TrackedFrameSet
from maplab_py.interop.recordings.stream import EventStream
from maplab_py.simulation.scenario import MotionOptions
from maplab_py.simulation.simulate import simulate
from tests.frontend.simulated import scenario

_WALK_S, _STOP_S = 8.0, 60.0
_PHASES = (
    MotionOptions(kind="room_scan", duration_s=_WALK_S, turns=0.3),
    MotionOptions(kind="stationary", duration_s=_STOP_S),
    MotionOptions(kind="room_scan", duration_s=6.0, turns=0.2),
)
_SPEED_CHANGES_S = 1.5
"""Margin of the stop at both ends: phases are joined smoothly."""


@dataclasses.dataclass(frozen=True)
class Standing:
    """What happened during the stop."""

    cameras: int
    noise_px: float
    starts: int
    drift_m: float
    largest_m: float
    resting_share: float  # of the frames of the stop


def run(cameras: int, noise_px: float) -> Standing:
    """Simulate and estimate one session."""
    chosen = scenario(_PHASES, cameras)
    measurement = dataclasses.replace(chosen.measurement, keypoint_sigma_px=noise_px)
    data = simulate(dataclasses.replace(chosen, measurement=measurement))
    recording = MapRecording(data.maps[0], 0)
    odometry = Odometry(recording.device)
    times_s, positions, motions = [], [], []
    for event in EventStream(recording):
        if isinstance(event, ImuBatch):
            updates = odometry.push_imu(event)
        else:
            assert isinstance(event, TrackedFrameSet)
            updates = odometry.push_frames(event)
        for update in updates:
            time_s = (update.time_ns - recording.start_ns) * 1e-9
            is_in_stop = abs(time_s - _WALK_S - 0.5 * _STOP_S) < 0.5 * _STOP_S - _SPEED_CHANGES_S
            if is_in_stop and update.state is not None:
                times_s.append(time_s)
                positions.append(update.state.T_M_I[0, 4:])
                motions.append(update.motion.value)
    t, p = np.array(times_s), np.array(positions)
    drift = p[t > t[-1] - 1.0].mean(axis=0) - p[t < t[0] + 1.0].mean(axis=0)
    return Standing(
        cameras,
        noise_px,
        odometry.starts,
        float(np.linalg.norm(drift)),
        float(pdist(p).max()),
        Counter(motions)["resting"] / len(motions),
    )


def main() -> None:
    """Measure and print; write JSON if asked to."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    results = []
    for cameras in (2, 1):
        for noise_px in (0.15, 0.8):
            results.append(dataclasses.asdict(run(cameras, noise_px)))
            print({name: round(value, 4) for name, value in results[-1].items()}, flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
