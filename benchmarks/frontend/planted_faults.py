"""Odometry with one fault: `python -m benchmarks.frontend.planted_faults [--folder=FOLDER] [--only=WORDS]`.

A flight with EuRoC's cameras (V1_01) and a handheld walk with a fisheye (TUM-VI, room 4) are rendered.
Each fault is planted alone and run as `rovioli` runs it, with all cameras and with the first. Printed are
the error of the map after SE(3) alignment, and the errors of the calibration that the map has at its end.
"""

import argparse
import dataclasses
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from benchmarks.frontend import strangers
from benchmarks.frontend.sequences import TRUTH
from maplab_py.interop.recordings.options import SourceOptions
from maplab_py.interop.recordings.protocol import Recording
from maplab_py.interop.recordings.reader_choice import open_recording
from maplab_py.interop.trajectories import read_trajectory
from maplab_py.sensors import Camera
from maplab_py.simulation.scenario import SessionOptions
from maplab_py.simulation.scenario_file import load_scenario
from tests.algorithms.recording_check import faults
from tests.support.data import shared_data_folder

_ROWS = 480
_LINES_S = {
    "flight": 0.0,
    "handheld": 0.0,
    "rolling 15 ms": 0.015 / _ROWS,
    "rolling 20 ms": 0.02 / _ROWS,
}
"""Recordings, and the line delay of their cameras."""


@dataclasses.dataclass(frozen=True)
class Case:
    """A recording with one fault."""

    words: str
    recording: str
    plant: Callable[[Recording], Recording] = faults.sound
    shift_s: float = 0.0  # by which the IMU's stamps are later


def _clock(shift_s: float) -> Case:
    words = f"offset {1e3 * shift_s:g} ms"
    return Case(words, "flight", lambda r: faults.with_clock(r, shift_s), shift_s)


def _focal_and_centre(camera: Camera) -> Camera:
    changed = camera.intrinsics * np.array([1.01, 1.01, 1.0, 1.0])
    return dataclasses.replace(camera, intrinsics=changed + np.array([0.0, 0.0, 4.0, -3.0]))


def cases() -> Iterator[Case]:
    """Yield the cases."""
    yield Case("nothing wrong", "flight")
    yield _clock(0.005)
    yield _clock(0.015)
    yield Case("turned 1 deg", "flight", lambda r: faults.with_rig(r, turn_deg=(0.6, -0.64, 0.48)))
    yield Case("f 1 %", "flight", lambda r: faults.with_rig(r, camera=faults.focal(1.01)))
    yield Case("rolling shutter, 15 ms", "rolling 15 ms")
    yield Case("handheld fisheye", "handheld")
    yield Case(
        "extrinsics 10 deg 2 cm", "flight",
        lambda r: faults.with_rig(r, turn_deg=(6.0, -6.4, 4.8), move_m=(0.012, -0.0128, 0.0096)),
    )  # fmt: skip
    yield _clock(0.05)
    yield Case("rolling shutter, 20 ms", "rolling 20 ms")
    yield Case(
        "focal 1 %, centre 5 px", "flight", lambda r: faults.with_rig(r, camera=_focal_and_centre)
    )


def _stranger(recording: str, duration_s: float) -> strangers.Stranger:
    """Return what is rendered, and its line delay."""
    scenario = load_scenario("flight_easy").with_seed(6)
    file = shared_data_folder() / "euroc_imu" / "V101.gt.csv"
    if recording == "handheld":
        file = shared_data_folder() / "tumvi_imu" / "room4.gt.csv"
        scenario = dataclasses.replace(scenario, cameras=(strangers.FISHEYE,))
    line_s = _LINES_S[recording]
    scenario = dataclasses.replace(
        scenario,
        cameras=tuple(dataclasses.replace(c, line_delay_s=line_s) for c in scenario.cameras),
        measurement=dataclasses.replace(scenario.measurement, max_keypoints=50),
        sessions=(
            SessionOptions(trajectory=str(file), trajectory_start_s=2.0, duration_s=duration_s),
        ),
    )
    return strangers.Stranger(scenario, line_s, 0.0, ())


def rendered(folder: Path, name: str, duration_s: float) -> tuple[strangers.Stranger, Path]:
    """Render a recording unless it is there; return both."""
    stranger = _stranger(name, duration_s)
    target = folder / f"{name.replace(' ', '_')}_{duration_s:g}s"
    return stranger, strangers.rendered_once(stranger.scenario, target)


def main() -> None:
    """Print a line for each fault and number of cameras."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=Path("planted_faults"))
    parser.add_argument("--only", default="", help="cases whose words contain this")
    parser.add_argument("--cameras", nargs="+", default=["", "0"], help="camera indices of a run")
    parser.add_argument("--duration", type=float, default=60.0)
    arguments = parser.parse_args()
    for case in cases():
        if arguments.only not in case.words:
            continue
        stranger, folder = rendered(arguments.folder, case.recording, arguments.duration)
        rows = [""] if len(stranger.scenario.cameras) == 1 else arguments.cameras
        for cameras in rows:
            recording = open_recording(folder, SourceOptions(rovio_active_camera_indices=cameras))
            stamps = [
                int(file.stem) for file in folder.glob("**/cam0/data/*.*") if file.stem.isdigit()
            ]
            result = strangers.run(
                case.plant(recording),
                read_trajectory(folder / TRUTH),
                stranger.sound(recording).device,
                np.array(stamps, dtype=np.int64),
                is_optimised=False,
                shift_s=case.shift_s,
            )
            found = result.calibration.words if result.calibration is not None else "no map"
            sys.stdout.write(
                f"{case.words}, {len(recording.device.cameras)} cameras: starts {result.start_s:.2f} s, "
                f"ATE {1e3 * result.ate_m:.2f} mm, missions {result.missions}; {found}\n"
            )
            sys.stdout.write("".join(f"      {line}\n" for line in result.says))
            sys.stdout.flush()


if __name__ == "__main__":
    main()
