"""Content of a recording: rates, gaps, durations, and what a reader leaves out."""

import dataclasses
from collections.abc import Iterator

import numpy as np

from maplab_py.array_types import I64
from maplab_py.errors import MapError
from maplab_py.geometry.interpolation import nearest_rows
from maplab_py.interop.recordings import clocks, protocol
from maplab_py.interop.recordings.options import StreamOptions
from maplab_py.interop.recordings.stream import EventStream, StreamStatistics, Times
from maplab_py.progress import SILENT, Progress
from maplab_py.report import Report

_PROGRESS_EVERY = 50
_USUAL_ENCODINGS = {"mono8", "8UC1", "bgr8", "rgb8", "PNG", "JPEG"}
_SLOWEST_IMU_HZ = 90.0
_HOLE_STEPS, _HOLE_NS = 10.0, 1_000_000_000
_SPAN_NS = 500_000_000
"""By which an IMU may end before the images without a note."""


@dataclasses.dataclass(frozen=True)
class ImuSummary:
    """The IMU of a recording."""

    samples: int
    rate_hz: float
    largest_interval_s: float
    gaps: int  # intervals longer than --vio_imu_gap_s
    first_gap_s: float | None  # after the beginning of the recording, as flags count
    saturated_samples: int


@dataclasses.dataclass(frozen=True)
class CameraSummary:
    """One camera of a recording."""

    camera: int
    images: int
    rate_hz: float
    largest_interval_s: float
    width_px: int
    height_px: int
    unmatched_images: int  # without partners in the other cameras


class RecordingReport(Report):
    """Content of a recording."""

    recording: str
    kind: str
    start_ns: int  # the zero of flags and notes
    duration_s: float
    frame_sets: int
    frame_set_rate_hz: float
    dropped_before_imu: int  # frame sets before the first IMU sample
    checked_images: int
    imu: ImuSummary | None
    cameras: tuple[CameraSummary, ...]
    notes: tuple[str, ...]
    parts: tuple[protocol.PartSpan, ...] = ()  # where the clock starts again


def summarise(
    recording: protocol.Recording,
    options: StreamOptions | None = None,
    *,
    check_images: bool = False,
    progress: Progress = SILENT,
) -> RecordingReport:
    """Read a recording and report what is in it; of one whose clock starts again, its first part.

    Args:
        check_images: Check size and completeness of all images of frame sets, without decoding.

    Raises:
        MapError: The recording is empty or damaged.
        UserError: An option is wrong, or nothing was recorded in the chosen time.
    """
    options = options or StreamOptions()
    stream, checked = EventStream(recording, options), 0
    parts: tuple[protocol.PartSpan, ...] = ()
    encodings: dict[int, str] = {}
    unread: list[str] = []
    try:
        for event in stream:
            if isinstance(event, protocol.ImuBatch):
                continue
            if isinstance(event, protocol.FrameSet):
                for image in event.images:
                    if image.camera not in encodings:
                        encodings[image.camera] = _encoding(image, unread)
                    if check_images:
                        image.data.check()
                        checked += 1
            progress.check()
            if stream.statistics.frame_sets.count % _PROGRESS_EVERY == 0:
                progress.line(f"{stream.statistics.frame_sets.count} frame sets")
    except clocks.ClockRestart:
        parts = recording.parts()
    report = _report(recording, stream.statistics, checked, options, encodings)
    report = dataclasses.replace(report, notes=(*report.notes, *unread))
    if not parts:
        return report
    note = f"the clock starts again: figures are of part 1 of {len(parts)}, --recording_part=N reads another"
    return dataclasses.replace(report, parts=parts, notes=(note, *report.notes))


def _encoding(image: protocol.CameraImage, unread: list[str]) -> str:
    """Return the encoding of an image, empty if it cannot be read, which is added to `unread`."""
    try:
        image.data.check()
    except MapError as error:
        unread.append(str(error))
        return ""
    return image.data.encoding


def _report(
    recording: protocol.Recording,
    statistics: StreamStatistics,
    checked: int,
    options: StreamOptions,
    encodings: dict[int, str],
) -> RecordingReport:
    every = [times for times in (statistics.imu, *statistics.images) if times.count]
    start_ns, first_ns = recording.start_ns, min(times.first_ns for times in every)
    end_ns = max(times.last_ns for times in every)
    return RecordingReport(
        recording=recording.name,
        kind=recording.kind,
        start_ns=start_ns,
        duration_s=(end_ns - first_ns) / 1e9,
        frame_sets=statistics.frame_sets.count,
        frame_set_rate_hz=statistics.frame_sets.rate_hz,
        dropped_before_imu=statistics.dropped_before_imu,
        checked_images=checked,
        imu=_imu_summary(statistics, start_ns) if recording.device.imu_id else None,
        cameras=tuple(
            _camera_summary(recording, row, times, statistics.unmatched_images[row])
            for row, times in enumerate(statistics.images)
        ),
        notes=(
            *recording.device.notes,
            *recording.notes,
            *_notes(recording, statistics, options, encodings),
        ),
    )


def _notes(
    recording: protocol.Recording,
    statistics: StreamStatistics,
    options: StreamOptions,
    encodings: dict[int, str],
) -> Iterator[str]:
    """Yield what is odd; times count from the beginning of the recording, as those of flags."""
    zero_ns, imu = recording.start_ns, statistics.imu
    if not recording.device.imu_id and not recording.notes:
        yield "there is no IMU"
    if set(encodings.values()) - _USUAL_ENCODINGS - {""}:
        listed = ", ".join(
            f"camera {row} {name}" for row, name in sorted(encodings.items()) if name
        )
        yield f"images are converted: {listed}"
    if statistics.imu_gaps:
        yield (
            f"{statistics.imu_gaps} intervals between IMU samples are longer than "
            f"{options.imu_gap_s:g} s"
        )
    if imu.count > 1 and imu.rate_hz < _SLOWEST_IMU_HZ:
        yield f"the IMU delivers {imu.rate_hz:.3g} samples per second: 100 or more are wanted"
    if statistics.zero_note:
        yield statistics.zero_note
    if statistics.saturated_samples:
        yield f"{statistics.saturated_samples} IMU samples are saturated"
    if statistics.dropped_before_imu:
        yield f"{statistics.dropped_before_imu} frame sets before the first IMU sample"
    images = [times for times in statistics.images if times.count]
    last_ns = max((times.last_ns for times in images), default=imu.last_ns)
    if imu.count and imu.last_ns < last_ns - _SPAN_NS:
        yield (
            f"the IMU ends at {(imu.last_ns - zero_ns) * 1e-9:.2f} s, the images at "
            f"{(last_ns - zero_ns) * 1e-9:.2f} s"
        )
    for row, times in enumerate(statistics.images):
        hole_ns, begin_ns = times.largest_hole_ns
        usual_ns = np.median(np.diff(times.all_ns)) if times.count > 2 else 0.0
        if times.count > 2 and hole_ns > max(_HOLE_STEPS * usual_ns, _HOLE_NS):
            yield (
                f"camera {row}: no images for {hole_ns * 1e-9:.2f} s from {(begin_ns - zero_ns) * 1e-9:.2f} s"
                " on"
            )
    yield from _pair_notes(statistics, options)


def _pair_notes(statistics: StreamStatistics, options: StreamOptions) -> Iterator[str]:
    """Yield which images of camera 0 and another have no partner, and how far away the nearest ones are."""
    counts, unmatched = statistics.images, statistics.unmatched_images
    if len(counts) < 2 or not any(unmatched):
        return
    reference = np.asarray(counts[0].all_ns, dtype=np.int64)
    for row, times in enumerate(counts[1:], start=1):
        other = np.asarray(times.all_ns, dtype=np.int64)
        if not len(reference) or not len(other):
            yield f"camera {row if len(reference) else 0} has no images"
            continue
        tolerance_ns = options.nframe_sync_tolerance_ns
        far_ns = [
            apart_ns[apart_ns > tolerance_ns]
            for apart_ns in (nearest_apart_ns(reference, other), nearest_apart_ns(other, reference))
        ]
        if not any(map(len, far_ns)):
            continue
        is_first = len(far_ns[1]) > len(far_ns[0])
        alone, partner, count = (0, row, len(reference)) if is_first else (row, 0, len(other))
        apart_ns = far_ns[is_first]
        yield (
            f"{len(apart_ns)} of {count} images of camera {alone} have no partner in camera {partner}; the "
            f"nearest is {float(np.median(apart_ns)) * 1e-6:.3g} ms away at the median: check the trigger, "
            "or raise --vio_nframe_sync_tolerance_ns"
        )


def nearest_apart_ns(reference: I64, other: I64) -> I64:
    """Return how far each of some times (N,) is from the nearest of a reference (M,), M > 0, ascending."""
    return np.asarray(np.abs(other - reference[nearest_rows(reference, other)]))


def _imu_summary(statistics: StreamStatistics, start_ns: int) -> ImuSummary:
    imu = statistics.imu
    gap_ns = statistics.first_imu_gap_ns
    return ImuSummary(
        samples=imu.count,
        rate_hz=imu.rate_hz,
        largest_interval_s=imu.largest_step_ns / 1e9,
        gaps=statistics.imu_gaps,
        first_gap_s=(gap_ns - start_ns) / 1e9 if gap_ns >= 0 else None,
        saturated_samples=statistics.saturated_samples,
    )


def _camera_summary(
    recording: protocol.Recording, row: int, times: Times, unmatched: int
) -> CameraSummary:
    camera = recording.device.cameras[row]
    return CameraSummary(
        camera=row,
        images=times.count,
        rate_hz=times.rate_hz,
        largest_interval_s=times.largest_step_ns / 1e9,
        width_px=camera.width_px,
        height_px=camera.height_px,
        unmatched_images=unmatched,
    )
