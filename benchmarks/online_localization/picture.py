"""Draw docs/images/online_localization.svg: paths of the four modes in the map, and their errors.

python -m benchmarks.online_localization.picture [SEED [SHARE]]
"""

import sys
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np

from benchmarks.online_localization.modes import compare
from benchmarks.online_localization.simulated import Setting, searched, setting
from maplab_py.frontend.localization.options import OnlineLocalizationOptions
from maplab_py.interop.recordings.map_replay import MapRecording
from tests.frontend.known_start import KnownStart
from tests.support.data import REPOSITORY

TARGET = REPOSITORY / "docs" / "images" / "online_localization.svg"
NAMES = {"odo": "ODO", "pose": "pose", "swl": "SWL", "vil": "VIL"}
COLOURS = {"odo": "#999999", "pose": "#d9a441", "swl": "#3b7dd8", "vil": "#c0392b"}


def draw(of: Setting, share: float, target: Path = TARGET) -> None:
    """Localise a simulated vehicle and draw its position errors."""
    summary = of.summary(share)
    truth = of.truth_in_map(summary)
    result = compare(
        MapRecording(of.query, 0), searched(summary, share), OnlineLocalizationOptions(),
        make_starter=KnownStart(of.start, with_biases=True),
    )  # fmt: skip
    mpl.rcParams["svg.hashsalt"] = "maplab"
    figure, (above, axes) = plt.subplots(
        1, 2, figsize=(9.0, 3.0), layout="constrained", width_ratios=(1.0, 1.6)
    )
    above.plot(truth[:, 4], truth[:, 5], color="#222222", linewidth=3.0, alpha=0.25, label="truth")
    for mode, name in NAMES.items():
        poses = result.results[mode]
        rows = np.searchsorted(of.times_ns, poses.times_ns)
        error_m = np.linalg.norm(poses.T_G_I[:, 4:] - truth[rows, 4:], axis=1)
        seconds = (poses.times_ns - of.times_ns[0]) * 1e-9
        above.plot(poses.T_G_I[:, 4], poses.T_G_I[:, 5], color=COLOURS[mode], linewidth=0.9)
        axes.plot(seconds, 100.0 * error_m, label=name, color=COLOURS[mode], linewidth=1.2)
    above.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    above.legend(frameon=False, loc="center")
    axes.set(xlabel="time [s]", ylabel="position error in the map [cm]", ylim=(0.0, None))
    for each in (above, axes):
        each.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, ncols=4, loc="lower left", bbox_to_anchor=(0.0, 1.0))
    figure.savefig(target, metadata={"Date": None})


if __name__ == "__main__":
    words = sys.argv[1:]
    number = int(words[0]) if words else 1
    draw(
        setting(number, duration_s=30.0, landmarks=12_000),
        float(words[1]) if len(words) > 1 else 0.05,
    )
