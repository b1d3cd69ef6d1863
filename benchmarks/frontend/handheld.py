"""Causal errors of one handheld camera: `python -m benchmarks.frontend.handheld [--folder=FOLDER]`.

Stretches of TUM-VI's rooms 1 and 4 are rendered with a fisheye. Of the states as they were known at their
time, after SE(3) alignment of each stretch: the largest error, and how many are beyond 5 cm and beyond
three standard deviations of the odometry itself, too.
"""

import argparse
import dataclasses
import sys
from pathlib import Path

import numpy as np

from benchmarks.frontend import strangers
from benchmarks.frontend.sequences import TRUTH, position_errors
from maplab_py.frontend.mapping import Mapping
from maplab_py.frontend.odometry_update import OdometryUpdate
from maplab_py.frontend.run_options import OutputOptions, RunOptions
from maplab_py.interop.recordings.options import SourceOptions
from maplab_py.interop.recordings.reader_choice import open_recording
from maplab_py.interop.trajectories import read_trajectory
from maplab_py.simulation.scenario import Scenario, SessionOptions
from maplab_py.simulation.scenario_file import load_scenario
from tests.support.data import shared_data_folder

_STARTS_S = (5.0, 20.0, 35.0, 50.0, 65.0)
_LIMIT_M = 0.05


def stretch(room: int, start_s: float, duration_s: float) -> Scenario:
    """Return the scenario of a stretch of a room."""
    file = shared_data_folder() / "tumvi_imu" / f"room{room}.gt.csv"
    scenario = load_scenario("flight_easy").with_seed(room)
    session = SessionOptions(
        trajectory=str(file), trajectory_start_s=start_s, duration_s=duration_s
    )
    return dataclasses.replace(
        scenario,
        cameras=(strangers.FISHEYE,),
        measurement=dataclasses.replace(scenario.measurement, max_keypoints=50),
        sessions=(session,),
    )


def main() -> None:
    """Print a line for each stretch."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=Path("handheld"))
    parser.add_argument("--duration", type=float, default=20.0)
    arguments = parser.parse_args()
    for room in (1, 4):
        for start_s in _STARTS_S:
            scenario = stretch(room, start_s, arguments.duration)
            target = arguments.folder / f"room{room}_{start_s:g}_{arguments.duration:g}s"
            folder = strangers.rendered_once(scenario, target)
            sigmas_m: dict[int, float] = {}

            def see(
                update: OdometryUpdate, mapping: Mapping, known: dict[int, float] = sigmas_m
            ) -> None:
                if update.window is not None:
                    of_position = np.linalg.eigvalsh(update.window.covariance[:3, :3])
                    known[update.time_ns] = float(np.sqrt(of_position[-1]))

            mapping = Mapping(
                open_recording(folder, SourceOptions()),
                RunOptions(output=OutputOptions(run_map_builder=False)),
                on_estimate=see,
            )
            mapping.run()
            online = mapping.trajectory()
            errors_m, scale = position_errors(
                read_trajectory(folder / TRUTH), online.times_ns, online.T_R_B
            )
            sigma_m = np.array([sigmas_m.get(int(t), np.inf) for t in online.times_ns])
            is_beyond = errors_m > np.maximum(_LIMIT_M, 3.0 * sigma_m[: len(errors_m)])
            sys.stdout.write(
                f"room {room} from {start_s:g} s: starts {mapping.statistics.starts[0].time_s:.2f} s, "
                f"missions {len(mapping.statistics.starts)}, largest error {1e3 * errors_m.max():.1f} mm "
                f"(rms {1e3 * np.sqrt(np.mean(errors_m**2)):.1f}), scale {scale:.4f}, "
                f"beyond: {np.count_nonzero(errors_m > _LIMIT_M)}, and its own 3 sigma: "
                f"{np.count_nonzero(is_beyond)} of {len(errors_m)}\n"
            )
            sys.stdout.flush()


if __name__ == "__main__":
    main()
