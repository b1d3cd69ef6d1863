"""Memory of the front-end over minutes: `python -m benchmarks.frontend.memory [FOLDER]`.

A EuRoC folder with ground truth is played forwards and backwards in turn, without a map builder, with
stamps that go on. Backwards the device passes through the same places with opposite velocity: the
accelerometer measures the same, the gyroscope the opposite but for its bias. The path turns round where
the device is slowest, so that the step of the velocity there is small. Resident memory is compared with
that after the first minute.
"""

import argparse
import dataclasses
import itertools
import json
import os
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.frontend.sequences import TRUTH
from maplab_py.frontend.mapping import Mapping
from maplab_py.frontend.odometry_update import OdometryUpdate
from maplab_py.frontend.run_options import OutputOptions, RunOptions
from maplab_py.interop.recordings.options import SourceOptions
from maplab_py.interop.recordings.protocol import (
    CameraImage,
    ImuBatch,
    Item,
    RecordedSensors,
    Recording,
)
from maplab_py.interop.recordings.reader_choice import open_recording
from maplab_py.interop.trajectories import read_trajectory
from tests.support.data import shared_data_folder

I64 = NDArray[np.int64]
_TURNING_S = 3.0
"""The path turns round at the slowest frames of so many seconds at both ends."""
_WARM_S = 60.0


@dataclasses.dataclass(frozen=True)
class MemoryUse:
    """Resident memory of a run."""

    minutes: float
    frames: int
    starts: int
    warm_mb: float  # after the first minute
    largest_mb: float  # later
    end_mb: float
    cpu_ms: float  # of a frame

    @property
    def growth_mb(self) -> float:
        """What the run needs beyond its first minute."""
        return self.largest_mb - self.warm_mb


class ThereAndBack:
    """A recording, played forwards and backwards again and again."""

    kind = "recording, forwards and backwards"
    notes: tuple[str, ...] = ()

    def __init__(self, plain: Recording, truth_file: Path, duration_s: float) -> None:
        """Read stamps and samples; images are decoded when they are needed."""
        self._plain, self._duration_ns = plain, round(duration_s * 1e9)
        items = list(plain.items())
        self._images = [item for item in items if isinstance(item, CameraImage)]
        batches = [item for item in items if isinstance(item, ImuBatch)]
        self._times_ns = np.concatenate([batch.times_ns for batch in batches])
        self._accel_gyro = np.concatenate([batch.accel_gyro for batch in batches])
        truth = read_trajectory(truth_file)
        assert truth.v_R is not None
        assert truth.gyro_bias is not None
        self._gyro_bias = np.median(truth.gyro_bias, axis=0)
        stamps = np.unique([image.time_ns for image in self._images])
        stamps = stamps[(stamps >= self._times_ns[0]) & (stamps <= self._times_ns[-1])]
        rows = np.minimum(np.searchsorted(truth.times_ns, stamps), len(truth.times_ns) - 1)
        speed = np.linalg.norm(truth.v_R[rows], axis=1)
        is_early = stamps <= stamps[0] + _TURNING_S * 1e9
        is_late = stamps >= stamps[-1] - _TURNING_S * 1e9
        self.start_ns, self._end_ns = (
            int(stamps[np.argmin(np.where(there, speed, np.inf))]) for there in (is_early, is_late)
        )

    @property
    def name(self) -> str:
        return self._plain.name

    @property
    def device(self) -> RecordedSensors:
        return self._plain.device

    def items(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Item]:
        """Yield images and samples until the duration is over."""
        last_ns, length_ns = -1, self._end_ns - self.start_ns
        for number in itertools.count():
            begin_ns = self.start_ns + number * length_ns
            for item in self._pass(begin_ns, is_backwards=number % 2 == 1):
                if item.time_ns - self.start_ns > self._duration_ns:
                    return
                if isinstance(item, ImuBatch):
                    new = item.take(
                        slice(int(np.searchsorted(item.times_ns, last_ns, side="right")), None)
                    )
                    if len(new):
                        last_ns = int(new.times_ns[-1])
                        yield new
                elif not number or item.time_ns > begin_ns:  # else the last of the pass before
                    yield item

    def _pass(self, begin_ns: int, *, is_backwards: bool) -> Iterator[Item]:
        def moved(time_ns: I64) -> I64:
            return begin_ns + (self._end_ns - time_ns if is_backwards else time_ns - self.start_ns)

        def inside(time_ns: I64) -> NDArray[np.bool_]:
            return (time_ns >= self.start_ns) & (time_ns <= self._end_ns)

        order = slice(None, None, -1 if is_backwards else 1)
        rows = np.flatnonzero(inside(self._times_ns))[order]
        times_ns, accel_gyro = moved(self._times_ns[rows]), self._accel_gyro[rows]
        if is_backwards:
            accel_gyro[:, 3:] = 2.0 * self._gyro_bias - accel_gyro[:, 3:]
        done, imu = 0, self.device.imu
        assert imu is not None
        for image in self._images[order]:
            if not inside(np.asarray(image.time_ns)):
                continue
            time_ns = int(moved(np.asarray(image.time_ns)))
            end = int(np.searchsorted(times_ns, time_ns, side="right"))
            if end > done:
                yield ImuBatch.of(imu, times_ns[done:end], accel_gyro[done:end])
                done = end
            yield dataclasses.replace(image, time_ns=time_ns, stamp_ns=time_ns)
        if done < len(times_ns):
            yield ImuBatch.of(imu, times_ns[done:], accel_gyro[done:])


class _Watch:
    """Resident memory while a run goes on."""

    def __init__(self) -> None:
        self.warm_mb = self.largest_mb = float("nan")

    def after_frame(self, update: OdometryUpdate, mapping: Mapping) -> None:
        """Look once a second of the recording."""
        if mapping.statistics.frames % 20 == 0 and mapping.statistics.duration_s >= _WARM_S:
            now_mb = resident_mb()
            if np.isnan(self.warm_mb):
                self.warm_mb = self.largest_mb = now_mb
            self.largest_mb = max(self.largest_mb, now_mb)


def resident_mb() -> float:
    """Return the resident memory of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def measure(folder: Path, minutes: float, cameras: str) -> MemoryUse:
    """Run the odometry for some minutes."""
    plain = open_recording(folder, SourceOptions(rovio_active_camera_indices=cameras))
    recording = ThereAndBack(plain, folder / TRUTH, 60.0 * minutes)
    watch = _Watch()
    options = RunOptions(output=OutputOptions(run_map_builder=False))
    mapping = Mapping(recording, options, observer=watch)
    began_s = time.process_time()
    mapping.run()
    spent_s = time.process_time() - began_s
    statistics = mapping.statistics
    return MemoryUse(
        statistics.duration_s / 60.0,
        statistics.frames,
        len(statistics.starts),
        watch.warm_mb,
        watch.largest_mb,
        resident_mb(),
        1e3 * spent_s / statistics.frames,
    )


def main() -> None:
    """Measure and print; write JSON if asked to."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--cameras", default="", help="numbers of the cameras; empty = all")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    folder = arguments.folder or shared_data_folder() / "euroc_mh01_10s"
    use = measure(folder, arguments.minutes, arguments.cameras)
    result = {**dataclasses.asdict(use), "growth_mb": use.growth_mb}
    for name, value in result.items():
        print(name.replace("_", " "), round(value, 2))
    if arguments.json:
        arguments.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
