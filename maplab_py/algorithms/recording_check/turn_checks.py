"""Checks of the gyroscope against the turns of the images: unit, axes, clock, mounting, scale, shutter."""

from collections.abc import Iterator, Sequence

import numpy as np

from maplab_py.algorithms.recording_check.findings import Finding, Verdict, ok, unknown
from maplab_py.algorithms.recording_check.hand_eye import SCALE, TURN
from maplab_py.algorithms.recording_check.inertial_checks import axes_text
from maplab_py.algorithms.recording_check.rates import CameraTurns
from maplab_py.sensors import Camera

_LEAST_RATE_DEG = 1.5
"""Slower turns [deg/s] do not show what the gyroscope measures."""
_SIGMAS = 4.0
_DELAY_S, _NOTED_DELAY_S = 8e-3, 4e-3
_MOUNTING_DEG = 2.5
_SCALE = 0.06
"""Before flat walls, turns and translations look alike: scales of sound recordings are within 0.045."""
_READOUT_S = 8e-3
_WIDEST_ERROR_PX = 1.0


def check_agreement(camera: CameraTurns) -> Finding:
    """Return a finding on whether the gyroscope turns as the images do, in whatever unit and axes."""
    check, expected = "turn of the images", "that of the gyroscope"
    if camera.rate_map is None:
        return unknown(check, "too few images that share points and have samples", expected)
    observed = (
        f"{camera.rate_deg:.2g} deg/s, the gyroscope explains {camera.rate_map.explained:.0%}"
    )
    if camera.agrees:
        return ok(check, observed, expected)
    if camera.rate_deg < _LEAST_RATE_DEG:
        return unknown(check, f"{camera.rate_deg:.2g} deg/s: turn the device more", expected)
    remedy = "are IMU and images of the same device and time? check topics and stamps"
    return Finding(check, observed, expected, Verdict.WRONG, remedy)


def check_unit(camera: CameraTurns) -> Finding:
    """Return a finding on the unit of the gyroscope."""
    check, expected = "unit of the gyroscope", "rad/s"
    if not camera.agrees:
        return unknown(check, "it does not agree with the images", expected)
    if camera.unit == 1.0:
        return ok(check, "rad/s", expected)
    remedy = f"multiply rates by {camera.unit:.7g}"
    return Finding(check, camera.unit_name, expected, Verdict.WRONG, remedy)


def check_axes(camera: CameraTurns, raw_agree: bool | None) -> Finding:
    """Return a finding on the axes of the gyroscope, or on a camera that is mounted otherwise.

    Args:
        camera: Analysis.
        raw_agree: The accelerometer agrees with the gyroscope as recorded; None = not known.
    """
    check, expected = "axes of the gyroscope", "x, y, z of the IMU, right-handed"
    if not camera.agrees:
        return unknown(check, "it does not agree with the images", expected)
    if np.array_equal(camera.axes, np.eye(3)):
        return ok(check, "as the calibration says", expected)
    axes = axes_text(camera.axes)
    if np.linalg.det(camera.axes) < 0.0:
        which = "of the IMU" if raw_agree else "of the gyroscope"
        remedy = f"axes are exchanged or have another sign: (x, y, z) = {axes} {which}"
        return Finding(check, f"{axes}, a mirror image", expected, Verdict.WRONG, remedy)
    if raw_agree:
        return Finding(
            "rotation of the extrinsics",
            f"turned by axes: the IMU's {axes}",
            "the T_cam_imu of the calibration",
            Verdict.WRONG,
            "T_B_C (kalibr: T_cam_imu) is of other axes, or its inverse: --apply writes the rotation",
        )
    remedy = f"(x, y, z) = {axes} of the gyroscope"
    remedy += "" if raw_agree is False else ", or the extrinsics are of other axes (T_cam_imu)"
    return Finding(check, axes, expected, Verdict.WRONG, remedy)


def check_clock(cameras: Sequence[CameraTurns], models: Sequence[Camera]) -> Finding:
    """Return a finding on the time offset between images and IMU."""
    check, expected = "time offset", "that of the calibration, to 4 ms"
    fit = cameras[0].hand_eye
    if fit is None or not cameras[0].agrees:
        return unknown(check, "the gyroscope does not agree with the images", expected)
    delay_ms, sigma_ms = 1e3 * fit.delay_s, 1e3 * fit.delay_sigma_s
    later = "after" if delay_ms >= 0.0 else "before"
    observed = f"images were taken {abs(delay_ms):.1f} +- {sigma_ms:.1f} ms {later} their stamps"
    if sigma_ms > 0.3e3 * _DELAY_S and abs(delay_ms) < _SIGMAS * sigma_ms:
        return unknown(check, f"{observed}: too little change of the turn", expected)
    total_ns = models[0].time_offset_ns + round(fit.delay_s * 1e9)
    remedy = (
        f"time_offset_ns: {total_ns} in sensors.yaml (kalibr: timeshift_cam_imu), or "
        f"--imu_to_camera_time_offset_ns={total_ns}"
    )
    is_sure = abs(delay_ms) > _SIGMAS * sigma_ms
    if is_sure and abs(fit.delay_s) > _DELAY_S:
        return Finding(check, observed, expected, Verdict.WRONG, remedy)
    if is_sure and abs(fit.delay_s) > _NOTED_DELAY_S:
        return Finding(check, observed, expected, Verdict.NOTE, remedy)
    return ok(check, observed, expected)


def check_mounting(cameras: Sequence[CameraTurns]) -> Iterator[Finding]:
    """Yield a finding on the rotation of the extrinsics of each camera."""
    for row, camera in enumerate(cameras):
        check = f"rotation of the extrinsics, camera {row}"
        expected = "that of the calibration, to 2.5 deg"
        if camera.hand_eye is None or not camera.agrees:
            yield unknown(check, "the gyroscope does not agree with the images", expected)
            continue
        error = np.degrees(camera.mounting_error)
        sigma = np.degrees(camera.hand_eye.turn_sigma)
        angle = float(np.linalg.norm(error))
        along = float(np.linalg.norm(sigma * error) / max(angle, 1e-9))
        observed = f"off by {angle:.1f} +- {along:.1f} deg"
        if along > _MOUNTING_DEG:
            yield unknown(check, f"{observed}: turn about all axes", expected)
        elif angle > max(_MOUNTING_DEG, _SIGMAS * along) and camera.is_better_than_held(TURN):
            turn = ", ".join(f"{value:.1f}" for value in error)
            remedy = (
                f"T_B_C (kalibr: T_cam_imu) of camera {row} is to be turned by ({turn}) deg in the camera's "
                "frame: --apply writes it, or --vio_estimate=extrinsics"
            )
            yield Finding(check, observed, expected, Verdict.WRONG, remedy)
        else:
            yield ok(check, observed, expected)


def scale_of(camera: CameraTurns) -> float | None:
    """Return the scale of the gyroscope by a camera, if it is sure to be off; None if it is not."""
    fit = camera.hand_eye
    if fit is None or not camera.agrees:
        return None
    is_off = abs(fit.scale - 1.0) > max(_SCALE, _SIGMAS * fit.scale_sigma)
    return fit.scale if is_off and camera.is_better_than_held(SCALE) else None


def check_scale(cameras: Sequence[CameraTurns]) -> Finding:
    """Return a finding on the scale of the gyroscope; cameras that differ say that one of them is wrong."""
    check, expected = "scale of the gyroscope", "1 +- 0.06"
    fits = [c.hand_eye for c in cameras if c.hand_eye is not None and c.agrees]
    if not fits:
        return unknown(check, "the gyroscope does not agree with the images", expected)
    observed = ", ".join(f"{fit.scale:.3f} +- {fit.scale_sigma:.3f}" for fit in fits)
    scales = [scale_of(camera) for camera in cameras]
    if scales[0] is None or (len(fits) > 1 and any(scale is None for scale in scales)):
        return ok(check, observed, expected)
    remedy = f"T_g of the IMU in sensors.yaml: {fits[0].scale:.3f} on its diagonal"
    if len(fits) == 1:
        remedy += f", or the focal length is off: times {1.0 / fits[0].scale:.3f}"
    return Finding(check, observed, expected, Verdict.WRONG, remedy)


def check_shutter(cameras: Sequence[CameraTurns], models: Sequence[Camera]) -> Iterator[Finding]:
    """Yield a finding on the shutter of each camera that looks as if it rolled."""
    for row, (camera, model) in enumerate(zip(cameras, models, strict=True)):
        fit = camera.hand_eye
        check = f"shutter of camera {row}"
        known_s = 1e-9 * model.line_delay_ns * model.height_px
        expected = f"readout of {1e3 * known_s:.3g} ms" if known_s else "all rows at once"
        if fit is None or not camera.agrees or fit.readout_sigma_s > 0.5 * _READOUT_S:
            yield unknown(check, "the gyroscope does not tell", expected)
            continue
        off_s = fit.readout_s - known_s
        observed = (
            f"{1e3 * fit.readout_s:.1f} +- {1e3 * fit.readout_sigma_s:.1f} ms from top to bottom"
        )
        if abs(off_s) > max(_READOUT_S, _SIGMAS * fit.readout_sigma_s):
            line_ns = round(fit.readout_s * 1e9 / model.height_px)
            remedy = (
                f"a rolling shutter: line-delay-nanoseconds: {line_ns} in sensors.yaml, or "
                "--vio_estimate=line_delay"
            )
            yield Finding(check, observed, expected, Verdict.NOTE, remedy)
        else:
            yield ok(check, observed, expected)
