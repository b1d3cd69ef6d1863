"""What is in a recording: rates, gaps, durations, and what a reader leaves out."""

from __future__ import annotations

import dataclasses

from maplab_py.interop.recordings.options import StreamOptions
from maplab_py.interop.recordings.protocol import FrameSet, ImuBatch, Recording
from maplab_py.interop.recordings.stream import EventStream, StreamStatistics, Times
from maplab_py.progress import SILENT, Progress
from maplab_py.report import Report

_PROGRESS_EVERY = 50


@dataclasses.dataclass(frozen=True)
class ImuSummary:
    """The IMU of a recording."""

    samples: int
    rate_hz: float
    largest_interval_s: float
    gaps: int  # intervals longer than --vio_imu_gap_s
    first_gap_s: float | None  # after the beginning of the recording
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


@dataclasses.dataclass(frozen=True)
class RecordingReport(Report):
    """What is in a recording."""

    recording: str
    kind: str
    start_ns: int
    duration_s: float
    frame_sets: int
    frame_set_rate_hz: float
    dropped_before_imu: int  # frame sets before the first IMU sample
    checked_images: int
    imu: ImuSummary | None
    cameras: tuple[CameraSummary, ...]
    notes: tuple[str, ...]


def summarise(
    recording: Recording,
    options: StreamOptions | None = None,
    *,
    check_images: bool = False,
    progress: Progress = SILENT,
) -> RecordingReport:
    """Read a recording and report what is in it.

    Args:
        recording: Recording.
        options: Part of it, and how it is synchronised.
        check_images: Check size and completeness of all images of frame sets, without decoding.
        progress: Told of the progress.

    Raises:
        MapError: The recording is empty or damaged.
        UserError: An option is wrong, or nothing was recorded in the chosen time.
    """
    options = options or StreamOptions()
    stream, checked = EventStream(recording, options), 0
    for event in stream:
        if isinstance(event, ImuBatch):
            continue
        if isinstance(event, FrameSet) and check_images:
            for image in event.images:
                image.data.check()
                checked += 1
        progress.check()
        if stream.statistics.frame_sets.count % _PROGRESS_EVERY == 0:
            progress.line(f"{stream.statistics.frame_sets.count} frame sets")
    return _report(recording, stream.statistics, checked, options)


def _report(
    recording: Recording, statistics: StreamStatistics, checked: int, options: StreamOptions
) -> RecordingReport:
    every = [times for times in (statistics.imu, *statistics.images) if times.count]
    start_ns = min(times.first_ns for times in every)
    end_ns = max(times.last_ns for times in every)
    notes = [*recording.device.notes, *recording.notes]
    if not recording.device.imu_id and not recording.notes:
        notes.append("there is no IMU")
    if statistics.imu_gaps:
        notes.append(
            f"{statistics.imu_gaps} intervals between IMU samples are longer than "
            f"{options.imu_gap_s:g} s"
        )
    if statistics.saturated_samples:
        notes.append(f"{statistics.saturated_samples} IMU samples are saturated")
    if statistics.dropped_before_imu:
        notes.append(f"{statistics.dropped_before_imu} frame sets before the first IMU sample")
    if any(statistics.unmatched_images) and not statistics.frame_sets.count:
        notes.append("no images match: raise --vio_nframe_sync_tolerance_ns")
    return RecordingReport(
        recording=recording.name,
        kind=recording.kind,
        start_ns=start_ns,
        duration_s=(end_ns - start_ns) / 1e9,
        frame_sets=statistics.frame_sets.count,
        frame_set_rate_hz=statistics.frame_sets.rate_hz,
        dropped_before_imu=statistics.dropped_before_imu,
        checked_images=checked,
        imu=_imu_summary(statistics, start_ns) if recording.device.imu_id else None,
        cameras=tuple(
            _camera_summary(recording, row, times, statistics.unmatched_images[row])
            for row, times in enumerate(statistics.images)
        ),
        notes=tuple(notes),
    )


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


def _camera_summary(recording: Recording, row: int, times: Times, unmatched: int) -> CameraSummary:
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
