"""Drift of the odometry at rest after a flight: `python -m benchmarks.frontend.rest [--imu recorded]`.

The first 18.4 s of EuRoC's MH_04: the device is moved for 9.3 s from the first image on, then stands on
the ground. Its recorded images are not at hand; they are rendered along the recorded ground truth
(scenario `docs/examples/recorded_flights/machine_hall.yaml`), and the IMU samples are simulated, or those
recorded. Of the states as they were known at their time: the absolute trajectory error after SE(3)
alignment, the drift over the rest, from its first to its last second, and the largest distance between
two of its positions.
"""

import argparse
import dataclasses
import json
import shutil
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.frontend.sequences import TRUTH, position_errors
from maplab_py.frontend.mapping import Mapping
from maplab_py.frontend.run_options import OutputOptions, RunOptions
from maplab_py.interop.recordings.options import SourceOptions
from maplab_py.interop.recordings.reader_choice import open_recording
from maplab_py.interop.trajectories import Trajectory, read_trajectory
from maplab_py.simulation.raw_data import write_raw_data
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import simulate
from tests.support.data import REPOSITORY, shared_data_folder

_SCENARIO = REPOSITORY / "docs" / "examples" / "recorded_flights" / "machine_hall.yaml"
_DURATION_S, _REST_S = 18.4, (10.0, 18.3)
"""Length of the sequence, and when the device rests, a second after it was put down."""


@dataclasses.dataclass(frozen=True)
class RestResult:
    """Errors of one run."""

    cameras: int
    starts: int
    first_state_s: float
    ate_m: float
    scale: float  # true / estimated
    drift_at_rest_m: float  # from the first to the last second of the rest
    largest_at_rest_m: float  # between two positions of the rest
    true_largest_at_rest_m: float  # what the ground truth says


def render(folder: Path, *, has_recorded_imu: bool) -> Path:
    """Write the sequence as a EuRoC folder; return it."""
    for name in ("MH04.gt.csv", "MH04.imu.csv"):
        shutil.copy(shared_data_folder() / "euroc_imu" / name, folder / name)
    imu = ", recorded_imu: MH04.imu.csv" if has_recorded_imu else ""
    text = _SCENARIO.read_text(encoding="utf-8")
    text = text.replace("duration_s: 44", f"duration_s: {_DURATION_S}{imu}")
    (folder / _SCENARIO.name).write_text(text, encoding="utf-8")
    scenario = load_scenario(folder / _SCENARIO.name)
    return write_raw_data(scenario, simulate(scenario), folder / "written")[0]


def run(folder: Path, cameras: str) -> RestResult:
    """Run over the sequence and compare with its truth."""
    recording = open_recording(folder, SourceOptions(rovio_active_camera_indices=cameras))
    mapping = Mapping(recording, RunOptions(output=OutputOptions(run_map_builder=False)))
    mapping.run()
    truth, online = read_trajectory(folder / TRUTH), mapping.trajectory()
    errors, scale = position_errors(truth, online.times_ns, online.T_R_B)
    first_ns = int(truth.times_ns[0])
    return RestResult(
        len(recording.device.cameras),
        len(mapping.statistics.starts),
        mapping.statistics.starts[0].time_s,
        float(np.sqrt(np.mean(errors**2))),
        scale,
        *_drift_m(online, first_ns),
        _drift_m(truth, first_ns)[1],
    )


def _drift_m(trajectory: Trajectory, first_ns: int) -> tuple[float, float]:
    """Return the drift over the rest, and the largest distance between two of its positions."""
    time_s = (trajectory.times_ns - first_ns) * 1e-9
    begin_s, end_s = _REST_S
    p, rests = trajectory.T_R_B[:, 4:], (time_s >= begin_s) & (time_s <= end_s)
    first, last = rests & (time_s < begin_s + 1.0), rests & (time_s > end_s - 1.0)
    drift = np.linalg.norm(p[last].mean(axis=0) - p[first].mean(axis=0))
    return float(drift), float(np.linalg.norm(p[rests][:, None] - p[rests][None], axis=2).max())


def main() -> None:
    """Measure and print; write JSON if asked to."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--imu", choices=("simulated", "recorded"), default="simulated")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    results = []
    with tempfile.TemporaryDirectory() as place:
        folder = render(Path(place), has_recorded_imu=arguments.imu == "recorded")
        for cameras in ("", "0"):
            results.append(dataclasses.asdict(run(folder, cameras)))
            print(arguments.imu, {name: round(value, 4) for name, value in results[-1].items()})
    if arguments.json:
        arguments.json.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
