"""The doctor: all checks of a recording, causes before effects, and their summary in one line for a run."""

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from maplab_py.algorithms.recording_check import image_checks, inertial_checks, stereo, turn_checks
from maplab_py.algorithms.recording_check.findings import (
    Check,
    Finding,
    RecordingCheck,
    Verdict,
    cause,
)
from maplab_py.algorithms.recording_check.rates import CameraTurns, analyse_camera
from maplab_py.algorithms.recording_check.signals import Signals, read_signals
from maplab_py.algorithms.recording_check.timing_checks import cannot_work, check_times
from maplab_py.errors import MapError, UserError
from maplab_py.geometry import se3
from maplab_py.interop.recordings import map_replay, protocol
from maplab_py.interop.recordings.options import StreamOptions
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import VIMap

QUICK_S = 4.0
"""Seconds at the beginning that a run looks at before it starts."""
_STEREO_PX, _SWAPPED_SHARE, _FITS_PX, _UNLIKE_SCALE = 1.2, 0.5, 0.4, 0.015


@dataclasses.dataclass(frozen=True, eq=False)
class Diagnosis:
    """Findings, and the figures behind them."""

    signals: Signals
    findings: tuple[Finding, ...]
    cameras: tuple[CameraTurns, ...]  # none if nothing can be compared


def diagnose(
    recording: protocol.Recording,
    stream: StreamOptions | None = None,
    *,
    first_s: float = 0.0,
    progress: Progress = SILENT,
) -> Diagnosis:
    """Check a recording.

    Args:
        stream: Part of it, and how it is synchronised.
        first_s: Look at so many seconds only; 0 = all.

    Raises:
        MapError: A table of it is damaged.
        UserError: An option is wrong.
    """
    stream = stream or StreamOptions()
    signals = read_signals(recording, stream, first_s=first_s, progress=progress)
    return diagnose_signals(signals, stream, is_whole=not first_s)


def diagnose_signals(
    signals: Signals, stream: StreamOptions | None = None, *, is_whole: bool = True
) -> Diagnosis:
    """Check signals; see `diagnose`."""
    stream = stream or StreamOptions()
    findings = list(check_times(signals, stream, is_whole=is_whole))
    if cannot_work(signals, is_whole=is_whole):
        return Diagnosis(signals, tuple(findings), ())
    cameras = _analyse_cameras(signals)
    findings += image_checks.check_images(signals)
    findings += [*_check_motion(signals, cameras), *_check_noise(signals, cameras)]
    return Diagnosis(signals, tuple(findings), cameras)


def report(diagnosis: Diagnosis, recording: protocol.Recording) -> RecordingCheck:
    """Return the report on a diagnosis."""
    signals = diagnosis.signals
    return RecordingCheck(
        recording=recording.name,
        duration_s=signals.duration_s,
        checked_images=sum(len(camera.figures) for camera in signals.cameras),
        findings=diagnosis.findings,
        notes=(*recording.device.notes, *recording.notes),
    )


def first_cause(diagnosis: Diagnosis) -> Finding | None:
    """Return the first cause of a recording's faults; None without a fault."""
    first = cause(diagnosis.findings)
    is_grave = first is not None and first.verdict in (Verdict.WRONG, Verdict.HOPELESS)
    return first if is_grave else None


def check_first_seconds(recording: protocol.Recording, stream: StreamOptions) -> tuple[str, ...]:
    """Return a line on faults in the first seconds, none if there are none.

    Raises:
        UserError: No map can be made of the recording.
    """
    try:
        first = first_cause(diagnose(recording, stream, first_s=QUICK_S))
    except MapError:
        return ()  # whoever reads on is told, and keeps what comes before
    if first is None:
        return ()
    if first.verdict is Verdict.HOPELESS:
        raise UserError(f"{recording.name}: {first.line}")
    return (f"first {QUICK_S:g} s: {first.line} (check_recording tells more)",)


def explain_refusal(diagnosis: Diagnosis | None, name: str, reason: str) -> str:
    """Return why odometry has not started: faults of the recording, else the given reason."""
    first = None if diagnosis is None else first_cause(diagnosis)
    if first is None:
        return reason
    return f"{name}: the odometry has not started: {first.line} (check_recording tells more)"


def check_map(vi_map: VIMap) -> tuple[Finding, ...]:
    """Return how tracks and samples of the longest mission contradict the calibration.

    The first seconds of a recording may not show an error that deforms its map.
    """
    return tuple(f for f in map_findings(vi_map) if f.verdict in (Verdict.WRONG, Verdict.NOTE))


def map_findings(vi_map: VIMap) -> tuple[Finding, ...]:
    """Return all findings on the calibration of the longest mission; none if it shows nothing."""
    if not len(vi_map.vertices):
        return ()
    counts = np.bincount(vi_map.vertices.mission, minlength=len(vi_map.missions))
    try:
        recording = map_replay.MapRecording(vi_map, int(np.argmax(counts)))
        signals = read_signals(recording)
    except MapError:
        return ()
    if cannot_work(signals, is_whole=True):
        return ()
    return tuple(_check_motion(signals, _analyse_cameras(signals)))


def _analyse_cameras(signals: Signals) -> tuple[CameraTurns, ...]:
    return tuple(analyse_camera(signals, row) for row in range(len(signals.cameras)))


def _check_motion(signals: Signals, cameras: Sequence[CameraTurns]) -> Iterator[Finding]:
    """Yield findings on the IMU, and on the cameras against it."""
    first = cameras[0]
    quiet = inertial_checks.measured_quiet(signals)
    accel = signals.imu.accel_gyro[:, :3] * inertial_checks.accel_unit(quiet)
    yield from inertial_checks.check_magnitude(signals, quiet)
    alone = None if first.agrees else inertial_checks.check_gyro_alone(signals)
    yield alone if alone is not None else turn_checks.check_agreement(first)
    yield turn_checks.check_unit(first)
    raw_agree = inertial_checks.raw_axes_agree(signals, accel, first)
    yield turn_checks.check_axes(first, raw_agree)
    is_exchanged = not np.array_equal(first.axes, np.eye(3))
    if not is_exchanged:  # otherwise it would only say the same again
        axes, agree = inertial_checks.check_accel_axes(signals, accel, first)
        yield axes
        if agree:
            yield inertial_checks.check_accel_sign(signals, accel, first)
    yield turn_checks.check_clock(cameras, signals.device.cameras)
    if not is_exchanged:
        yield from turn_checks.check_mounting(cameras)
    yield from _check_stereo(cameras, _stereo_fits(signals))
    yield turn_checks.check_scale(cameras)
    yield from turn_checks.check_shutter(cameras, signals.device.cameras)


def _check_noise(signals: Signals, cameras: Sequence[CameraTurns]) -> Iterator[Finding]:
    """Yield findings on the noise figures of the IMU."""
    if signals.device.imu is not None:
        quiet = inertial_checks.measured_quiet(signals)
        units = inertial_checks.accel_unit(quiet), cameras[0].unit
        yield from inertial_checks.check_noise(signals.device.imu, quiet, units)


def _stereo_fits(signals: Signals) -> list[stereo.StereoFit | None]:
    cameras, T_I_C = signals.device.cameras, signals.device.T_I_C
    return [
        stereo.fit_stereo(
            points, (cameras[0], cameras[row]), np.asarray(se3.relative(T_I_C[0], T_I_C[row]))
        )
        for row, points in enumerate(signals.stereo, start=1)
    ]


def _check_stereo(
    cameras: Sequence[CameraTurns], fits: Sequence[stereo.StereoFit | None]
) -> Iterator[Finding]:
    """Yield a finding on the first and each other camera that see the same."""
    for row, fit in enumerate(fits, start=1):
        check = Check(f"cameras 0 and {row}", f"points {_STEREO_PX:g} px from epipolar lines")
        if fit is None:
            yield check.unknown("too few points that both see")
            continue
        observed = f"{fit.as_is:.2f} px at the median of {fit.points} points"
        if fit.as_is <= _STEREO_PX:
            yield check.ok(observed)
        elif fit.swapped < _SWAPPED_SHARE * fit.as_is and fit.swapped < 2.0 * _STEREO_PX:
            observed += f", {fit.swapped:.2f} px with the cameras exchanged"
            remedy = (
                "exchange the images or topics of the cameras, or their entries in the calibration"
            )
            yield check.wrong(observed, remedy)
        elif fit.moved < _FITS_PX:
            observed += f", {fit.moved:.2f} px with camera {row} turned by {fit.turn_deg:.1f} deg"
            errors = [float(np.linalg.norm(cameras[c].mounting_error)) for c in (0, row)]
            # the gyroscope contradicts its mounting more
            which = 0 if errors[0] > errors[1] else row
            remedy = f"the extrinsics of camera {which} (T_B_C, kalibr: T_cn_cnm1): calibrate the rig again"
            yield check.wrong(observed, remedy)
        else:
            observed += f", {fit.moved:.2f} px whatever their poses"
            which = _unlike_camera(cameras, row)
            remedy = f"the intrinsics or distortion of camera {which}: calibrate it again"
            yield check.wrong(observed, remedy)


def _unlike_camera(cameras: Sequence[CameraTurns], row: int) -> int:
    """Return the camera whose turns have another size than the gyroscope's, or whose points fit worse."""
    fits = [cameras[c].hand_eye for c in (0, row)]
    if fits[0] is None or fits[1] is None:
        return row
    off = [abs(fit.scale - 1.0) for fit in fits if fit is not None]
    if abs(off[0] - off[1]) > _UNLIKE_SCALE:
        return 0 if off[0] > off[1] else row
    return 0 if fits[0].error_px > fits[1].error_px else row
