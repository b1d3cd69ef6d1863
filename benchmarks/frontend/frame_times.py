"""Processor time of a frame, all stages: `python -m benchmarks.frontend.frame_times [FOLDER]`.

A EuRoC folder is read with one camera and with all, with and without a map builder, and once more with an
estimator that is never content with its start, so that it tries again every quarter of a second: these frames
are the most expensive. Processor time does not depend on what else the machine does; the report of `rovioli`
has elapsed times.
"""

import argparse
import dataclasses
import json
import time
from pathlib import Path

import numpy as np

from maplab_py.errors import EstimationError
from maplab_py.frontend.initialization.options import InitializationOptions
from maplab_py.frontend.mapping import Mapping
from maplab_py.frontend.odometry_options import OdometryOptions
from maplab_py.frontend.odometry_update import OdometryUpdate
from maplab_py.frontend.run_options import OutputOptions, RunOptions
from maplab_py.interop.recordings.options import SourceOptions
from maplab_py.interop.recordings.reader_choice import open_recording
from tests.support.data import shared_data_folder

NEVER = InitializationOptions(max_scale_sigma=1e-9, max_tilt_sigma_deg=1e-9)


@dataclasses.dataclass(frozen=True)
class FrameTimes:
    """Processor times of the frames of a run [ms]."""

    cameras: int
    map_builder: bool
    starts: int
    frames: int
    median_ms: float
    p99_ms: float
    largest_ms: float


class FrameWatch:
    """Processor time from frame to frame."""

    def __init__(self) -> None:
        self.spent_ms: list[float] = []
        self._last_s = time.process_time()

    def after_frame(self, update: OdometryUpdate, mapping: Mapping) -> None:
        """Note the time since the frame before."""
        del update, mapping
        now_s = time.process_time()
        self.spent_ms.append(1e3 * (now_s - self._last_s))
        self._last_s = now_s


def measure(
    folder: Path, cameras: str, *, builds_map: bool = False, never_starts: bool = False
) -> FrameTimes:
    """Run over a folder."""
    recording = open_recording(folder, SourceOptions(rovio_active_camera_indices=cameras))
    odometry = OdometryOptions(initialization=NEVER) if never_starts else OdometryOptions()
    options = RunOptions(odometry=odometry, output=OutputOptions(run_map_builder=builds_map))
    watch = FrameWatch()
    mapping = Mapping(recording, options, observer=watch)
    try:
        mapping.run()
    except EstimationError:
        assert never_starts
    spent_ms = np.array(watch.spent_ms)
    return FrameTimes(
        len(recording.device.cameras),
        builds_map,
        len(mapping.statistics.starts),
        len(spent_ms),
        float(np.median(spent_ms)),
        float(np.percentile(spent_ms, 99)),
        float(spent_ms[1:].max()),  # the first loads kernels
    )


def main() -> None:
    """Measure and print; write JSON if asked to."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    folder = arguments.folder or shared_data_folder() / "euroc_mh01_10s"
    measure(folder, "")  # loads and compiles kernels
    results = []
    for cameras in ("0", ""):
        for given in ({"builds_map": True}, {"builds_map": False}, {"never_starts": True}):
            results.append(dataclasses.asdict(measure(folder, cameras, **given)))
            print({name: round(value, 1) for name, value in results[-1].items()}, flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
