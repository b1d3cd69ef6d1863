"""Signals of a recording that the checks look at, read once; images are sampled."""

import dataclasses
from array import array
from collections.abc import Iterable

import numpy as np

from maplab_py.algorithms.recording_check import image_samples
from maplab_py.algorithms.recording_check.stereo import StereoSampler
from maplab_py.array_types import F64, I64, Mask, Rows
from maplab_py.errors import MapError
from maplab_py.interop.recordings import clocks, options, protocol
from maplab_py.interop.recordings.stream import Synchroniser
from maplab_py.progress import SILENT, Progress

_DENSE_S, _BURST_S, _PERIOD_S = 60.0, 2.0, 10.0
"""Images of the first minute are looked at ten times a second, later ones two seconds in ten ..."""
_OTHER_BURST_S, _OTHER_PERIOD_S = 2.0, 5.0
"""... and those of other cameras than the first less often."""
_STEREO_EVERY_S = 0.5
_REPEAT_EVERY = 5
"""After so many sampled images the next one is compared with the one before."""


class ImuSignal(Rows):
    """All samples of the IMU."""

    times_ns: I64  # (N,)
    accel_gyro: F64  # (N, 6)
    is_saturated: Mask  # (N,)

    @property
    def rate_hz(self) -> float:
        """Mean rate; 0 for fewer than two samples."""
        span_ns = int(self.times_ns[-1] - self.times_ns[0]) if len(self) > 1 else 0
        return (len(self) - 1) * 1e9 / span_ns if span_ns > 0 else 0.0


@dataclasses.dataclass(frozen=True, eq=False)
class CameraSignal:
    """Images of one camera: all times, and what its sampled images show."""

    times_ns: I64  # (N,) in the clock of the IMU
    figures: tuple[image_samples.ImageFigures, ...]
    pairs: image_samples.PointPairs
    unmatched: int  # without partners in the other cameras
    damaged: int  # of the sampled images


@dataclasses.dataclass(frozen=True, eq=False)
class Signals:
    """Signals of a recording."""

    device: protocol.RecordedSensors
    start_ns: int
    imu: ImuSignal
    cameras: tuple[CameraSignal, ...]
    stereo: tuple[F64, ...]  # (M, 2, 2) [px] of points in the first and in each other camera
    restart: str = ""  # the clock starts again
    damage: str = ""  # of the first image that cannot be decoded

    @property
    def duration_s(self) -> float:
        """Time from the first to the last item."""
        times = [t for t in (self.imu.times_ns, *(c.times_ns for c in self.cameras)) if len(t)]
        if not times:
            return 0.0
        return float(max(t[-1] for t in times) - min(t[0] for t in times)) * 1e-9


def read_signals(
    recording: protocol.Recording,
    stream: options.StreamOptions | None = None,
    *,
    first_s: float = 0.0,
    progress: Progress = SILENT,
) -> Signals:
    """Read a recording.

    Args:
        stream: Part of it, and how it is synchronised.
        first_s: Look at images of so many seconds, and read on only until both images and samples have
            come; 0 = read all.

    Raises:
        MapError: A table of it is damaged.
    """
    stream = stream or options.StreamOptions()
    start_ns = recording.start_ns + round(stream.start_s * 1e9)
    end_ns = recording.start_ns + round(stream.end_s * 1e9) if stream.end_s else None
    reader = _Reader(recording.device, start_ns, stream.nframe_sync_tolerance_ns)
    restart = ""
    try:
        items = recording.items(start_ns if stream.start_s else None, end_ns)
        reader.read(items, first_s, progress)
    except clocks.ClockRestart as error:
        restart = str(error)
    return reader.signals(restart)


class _Reader:
    """Collects the signals from the items of a recording."""

    def __init__(self, device: protocol.RecordedSensors, start_ns: int, tolerance_ns: int) -> None:
        self._device, self._start_ns = device, start_ns
        cameras = device.cameras
        self._batches: list[protocol.ImuBatch] = []
        self._times_ns = [array("q") for _ in cameras]
        self._samplers = [
            image_samples.CameraSampler(camera, row) for row, camera in enumerate(cameras)
        ]
        self._stereo = [StereoSampler(cameras[0], camera) for camera in cameras[1:]]
        self._sets = Synchroniser(len(cameras), tolerance_ns)
        self._next_stereo_ns = 0
        self._sampled = [0] * len(cameras)
        self._damaged, self._damage = [0] * len(cameras), ""

    def read(self, items: Iterable[protocol.Item], first_s: float, progress: Progress) -> None:
        """Take all items, or those of the first seconds and the first of each kind."""
        until_ns = self._start_ns + round(first_s * 1e9)
        for count, item in enumerate(items):
            if count % 50 == 0:
                progress.check()
            looks = not first_s or item.time_ns < until_ns
            if not looks and self._batches and any(self._times_ns):
                break
            self._take(item, looks)

    def signals(self, restart: str) -> Signals:
        """Return the signals."""
        none = ImuSignal(np.zeros(0, dtype=np.int64), np.zeros((0, 6)), np.zeros(0, dtype=np.bool_))
        imu = none
        if self._batches:
            imu = ImuSignal(
                np.concatenate([batch.times_ns for batch in self._batches]),
                np.concatenate([batch.accel_gyro for batch in self._batches]),
                np.concatenate([batch.is_saturated for batch in self._batches]),
            )
        list(self._sets.finish())
        rows = zip(self._times_ns, self._samplers, self._sets.unmatched, self._damaged, strict=True)
        cameras = tuple(
            CameraSignal(
                np.asarray(times, dtype=np.int64),
                tuple(sampler.figures),
                image_samples.PointPairs.stack(sampler.pairs),
                unmatched,
                damaged,
            )
            for times, sampler, unmatched, damaged in rows
        )
        stereo = tuple(sampler.points() for sampler in self._stereo)
        return Signals(self._device, self._start_ns, imu, cameras, stereo, restart, self._damage)

    def _take(self, item: protocol.Item, looks: bool) -> None:
        for event in self._sets.push(item):
            if isinstance(event, protocol.FrameSet) and looks:
                self._look_at_set(event)
        if isinstance(item, protocol.ImuBatch):
            self._batches.append(item)
        elif isinstance(item, protocol.CameraImage):
            self._times_ns[item.camera].append(item.time_ns)
            if looks:
                self._look_at(item)
        elif isinstance(item, protocol.TrackedFrameSet):
            for frame in item.frames:
                if frame is not None:
                    self._times_ns[frame.camera].append(item.time_ns)
                    if self._is_sampled(frame.camera, item.time_ns):
                        self._samplers[frame.camera].add_tracks(frame, item.time_ns)

    def _is_sampled(self, camera: int, time_ns: int) -> bool:
        since_s = (time_ns - self._start_ns) * 1e-9
        if camera:
            is_in = since_s % _OTHER_PERIOD_S < _OTHER_BURST_S
        else:
            is_in = since_s < _DENSE_S or since_s % _PERIOD_S < _BURST_S
        return is_in and self._samplers[camera].is_due(time_ns)

    def _look_at(self, image: protocol.CameraImage) -> None:
        sampler, camera = self._samplers[image.camera], image.camera
        try:
            if self._is_sampled(camera, image.time_ns):
                self._sampled[camera] += 1
                sampler.add(image.time_ns, image.grey())
            elif self._sampled[camera] % _REPEAT_EVERY == 1:
                self._sampled[camera] += 1
                sampler.add_repeat(image.time_ns, image.grey())
        except MapError as error:
            self._damaged[camera] += 1
            self._damage = self._damage or str(error)

    def _look_at_set(self, images: protocol.FrameSet) -> None:
        if not self._stereo or images.time_ns < self._next_stereo_ns:
            return
        self._next_stereo_ns = images.time_ns + round(_STEREO_EVERY_S * 1e9)
        try:
            grey = [image.grey() for image in images.images]
        except MapError:
            return  # `_look_at` counts it
        for sampler, other in zip(self._stereo, grey[1:], strict=True):
            sampler.add(grey[0], other)
