"""Draw docs/images/recording_check.svg: rates of images and gyroscope of a good and of a bad recording.

MAPLAB_SHARED_DATA=DATA python docs/scripts/draw_recording_check.py
"""

import os
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np

from maplab_py.algorithms.recording_check.doctor import diagnose
from maplab_py.algorithms.recording_check.rates import CameraTurns
from maplab_py.interop.recordings.options import SourceOptions, StreamOptions
from maplab_py.interop.recordings.reader_choice import open_recording

IMAGE = Path(__file__).resolve().parents[1] / "images" / "recording_check.svg"
SECONDS = 10.0


def main() -> None:
    """Check both recordings and draw them."""
    shared = Path(os.environ.get("MAPLAB_SHARED_DATA", "../shared/data"))
    walk = shared / "handheld_room_70s"
    calibration = SourceOptions(
        sensor_calibration_file=walk / "camchain-imucam.yaml",
        imu_calibration_file=walk / "imu.yaml",
    )
    mpl.rcParams["svg.hashsalt"] = "maplab-py"  # the same bytes every time
    figure, axes = plt.subplots(2, 1, figsize=(7.5, 4.6), layout="constrained")
    for axis, title, folder, source in (
        (axes[0], "EuRoC MH_01", shared / "euroc_mh01_10s", SourceOptions()),
        (axes[1], "walk with a depth camera", walk, calibration),
    ):
        stream = StreamOptions(end_s=SECONDS if folder != walk else 25.0)
        diagnosis = diagnose(open_recording(folder, source), stream)
        draw(axis, diagnosis.cameras[0], title)
    axes[1].set_xlabel("time [s]")
    figure.savefig(IMAGE, metadata={"Date": None})


def draw(axis: plt.Axes, camera: CameraTurns, title: str) -> None:
    """Draw the rates about the optical axis, by images and by gyroscope, over ten seconds."""
    rays, gyro, fit = camera.rays, camera.gyro, camera.hand_eye
    assert gyro is not None
    assert fit is not None
    middle_ns = (rays.first_ns + rays.second_ns) // 2
    shown = middle_ns > middle_ns[-1] - SECONDS * 1e9
    seconds = (middle_ns[shown] - middle_ns[shown][0]) * 1e-9
    phi = gyro.phi(rays.first_ns, rays.second_ns) - camera.bias * rays.duration_s[:, None]
    for values, label in ((camera.turns.phi, "images"), (phi @ fit.R_I_C, "gyroscope")):
        rate = np.degrees(values[:, 2] / rays.duration_s)
        axis.plot(seconds, rate[shown], label=label, linewidth=1.2)
    axis.set_ylabel("roll [deg/s]")
    axis.set_title(title, fontsize=10)
    axis.legend(frameon=False, fontsize=8)


if __name__ == "__main__":
    main()
