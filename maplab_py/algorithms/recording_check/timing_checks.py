"""Checks of times: parts, spans, rates, gaps, and partners of images."""

from collections.abc import Iterator

import numpy as np

from maplab_py.algorithms.recording_check.findings import Check, Finding, Verdict
from maplab_py.algorithms.recording_check.signals import Signals
from maplab_py.interop.recordings.options import StreamOptions
from maplab_py.interop.recordings.summary import nearest_apart_ns

_LEAST_IMU_HZ, _LEAST_IMAGE_HZ = 90.0, 7.0
_HOLE_S = 1.0
_LEAST_SHARED = 0.9
"""Share of the images that samples must cover."""
_UNMATCHED_SHARE = 0.05
_CLOCKS = "check clocks and units of the stamps (--time_unit, --imu_to_camera_time_offset_ns)"


def check_times(signals: Signals, stream: StreamOptions, *, is_whole: bool) -> Iterator[Finding]:
    """Yield findings on the times of samples and images.

    Args:
        stream: Limits of gaps, and of the times of partners.
        is_whole: The recording was read to its end.
    """
    if signals.restart:
        remedy = "read one part: --recording_part=N (recording_info lists them)"
        yield Check("clock", "increasing stamps").wrong("starts again", remedy)
    yield _check_spans(signals, is_whole)
    if len(signals.imu) > 1:
        yield from _check_imu_rate(signals, stream)
    for row, camera in enumerate(signals.cameras):
        if len(camera.times_ns) > 2:
            yield _check_images(signals, row)
    yield from _check_partners(signals, stream)


def cannot_work(signals: Signals, *, is_whole: bool) -> bool:
    """Return whether samples or images are missing, or have no time in common."""
    return _check_spans(signals, is_whole).verdict is Verdict.HOPELESS


def _check_spans(signals: Signals, is_whole: bool) -> Finding:
    check = Check("IMU and images", "samples while there are images")
    images = [camera.times_ns for camera in signals.cameras if len(camera.times_ns)]
    if not len(signals.imu):
        remedy = "name its topic (--imu_topic) or its file; rovioli needs an IMU"
        return check.hopeless("no IMU samples", remedy)
    if not images:
        remedy = "name their topics (--camera_topics), or give another folder"
        return check.hopeless("no images", remedy)
    first, last = int(signals.imu.times_ns[0]), int(signals.imu.times_ns[-1])
    begin, end = min(int(t[0]) for t in images), max(int(t[-1]) for t in images)
    if last < begin or first > end:
        apart_s = max(begin - last, first - end) * 1e-9
        return check.hopeless(f"no time in common, {apart_s:.4g} s apart", _CLOCKS)
    if not is_whole:
        return check.ok("overlap")
    times = images[0]
    share = float(np.mean((times >= first) & (times <= last)))
    observed = f"samples for {share:.0%} of the images"
    if share < _LEAST_SHARED:
        return check.wrong(observed, _CLOCKS)
    return check.ok(observed)


def _check_imu_rate(signals: Signals, stream: StreamOptions) -> Iterator[Finding]:
    steps_s = np.diff(signals.imu.times_ns) * 1e-9
    rate_hz = signals.imu.rate_hz
    check, observed = Check("rate of the IMU", f"{_LEAST_IMU_HZ:g} Hz or more"), f"{rate_hz:.4g} Hz"
    if rate_hz < _LEAST_IMU_HZ:
        remedy = "set the driver to a higher rate; slow motion only with this one"
        yield check.note(observed, remedy)
    else:
        yield check.ok(observed)
    gaps, largest = int(np.count_nonzero(steps_s > stream.imu_gap_s)), float(steps_s.max())
    check = Check("gaps of the IMU", f"none above {stream.imu_gap_s:g} s")
    if not gaps:
        yield check.ok(f"largest {largest:.3g} s")
        return
    at_s = (int(signals.imu.times_ns[np.argmax(steps_s)]) - signals.start_ns) * 1e-9
    missing = float(steps_s[steps_s > stream.imu_gap_s].sum()) / max(signals.duration_s, 1e-9)
    observed = f"{gaps}, the largest of {largest:.3g} s at {at_s:.2f} s"
    judge = check.wrong if missing > 0.05 else check.note
    yield judge(observed, "record again with a faster disk or a larger queue")


def _check_images(signals: Signals, row: int) -> Finding:
    steps_s = np.diff(signals.cameras[row].times_ns) * 1e-9
    usual, largest = float(np.median(steps_s)), float(steps_s.max())
    check = Check(f"rate of camera {row}", f"{_LEAST_IMAGE_HZ:g} Hz or more, no holes")
    observed = f"{1.0 / max(usual, 1e-9):.4g} Hz, longest step {largest:.3g} s"
    if 1.0 / max(usual, 1e-9) < _LEAST_IMAGE_HZ:
        return check.note(observed, "record more images a second, or move slowly")
    if largest > max(_HOLE_S, 10.0 * usual):
        return check.note(observed, "images were lost: record with a faster disk, or raw images")
    return check.ok(observed)


def _check_partners(signals: Signals, stream: StreamOptions) -> Iterator[Finding]:
    if len(signals.cameras) < 2:
        return
    count = sum(len(camera.times_ns) for camera in signals.cameras)
    unmatched = sum(camera.unmatched for camera in signals.cameras)
    tolerance_ns = stream.nframe_sync_tolerance_ns
    within = f"images of all cameras within {tolerance_ns * 1e-6:g} ms"
    check = Check("partners of images", within)
    share = unmatched / max(count, 1)
    observed = f"{share:.0%} of the images are alone"
    if share <= _UNMATCHED_SHARE:
        yield check.ok(observed)
        return
    first, other = (signals.cameras[row].times_ns for row in (0, 1))
    if len(first) and len(other):
        observed += f", the nearest {np.median(nearest_apart_ns(first, other)) * 1e-6:.3g} ms away"
    remedy = (
        "trigger the cameras together, raise --vio_nframe_sync_tolerance_ns, or read one camera "
        "(--rovio_active_camera_indices=0)"
    )
    yield check.wrong(observed, remedy)
