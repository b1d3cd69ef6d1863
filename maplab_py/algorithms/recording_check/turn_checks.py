"""Checks of the gyroscope against the turns of the images: unit, axes, clock, mounting, scale, shutter."""

from collections.abc import Iterator, Sequence

import numpy as np

from maplab_py.algorithms.recording_check.findings import Check, Finding
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
    check = Check("turn of the images", "that of the gyroscope")
    if camera.rate_map is None:
        return check.unknown("too few images that share points and have samples")
    observed = (
        f"{camera.rate_deg:.2g} deg/s, the gyroscope explains {camera.rate_map.explained:.0%}"
    )
    if camera.agrees:
        return check.ok(observed)
    if camera.rate_deg < _LEAST_RATE_DEG:
        return check.unknown(f"{camera.rate_deg:.2g} deg/s: turn the device more")
    remedy = "are IMU and images of the same device and time? check topics and stamps"
    return check.wrong(observed, remedy)


def check_unit(camera: CameraTurns) -> Finding:
    """Return a finding on the unit of the gyroscope."""
    check = Check("unit of the gyroscope", "rad/s")
    if not camera.agrees:
        return check.unknown("it does not agree with the images")
    if camera.unit == 1.0:
        return check.ok("rad/s")
    remedy = f"multiply rates by {camera.unit:.7g}"
    return check.wrong(camera.unit_name, remedy)


def check_axes(camera: CameraTurns, raw_agree: bool | None) -> Finding:
    """Return a finding on the axes of the gyroscope, or on a camera that is mounted otherwise.

    Args:
        camera: Analysis.
        raw_agree: The accelerometer agrees with the gyroscope as recorded; None = not known.
    """
    check = Check("axes of the gyroscope", "x, y, z of the IMU, right-handed")
    if not camera.agrees:
        return check.unknown("it does not agree with the images")
    if np.array_equal(camera.axes, np.eye(3)):
        return check.ok("as the calibration says")
    axes = axes_text(camera.axes)
    if np.linalg.det(camera.axes) < 0.0:
        which = "of the IMU" if raw_agree else "of the gyroscope"
        remedy = f"axes are exchanged or have another sign: (x, y, z) = {axes} {which}"
        return check.wrong(f"{axes}, a mirror image", remedy)
    if raw_agree:
        remedy = "T_B_C (kalibr: T_cam_imu) is of other axes, or its inverse: --apply writes the rotation"
        mounting = Check("rotation of the extrinsics", "the T_cam_imu of the calibration")
        return mounting.wrong(f"turned by axes: the IMU's {axes}", remedy)
    remedy = f"(x, y, z) = {axes} of the gyroscope"
    remedy += "" if raw_agree is False else ", or the extrinsics are of other axes (T_cam_imu)"
    return check.wrong(axes, remedy)


def check_clock(cameras: Sequence[CameraTurns], models: Sequence[Camera]) -> Finding:
    """Return a finding on the time offset between images and IMU."""
    check = Check("time offset", "that of the calibration, to 4 ms")
    fit = cameras[0].hand_eye
    if fit is None or not cameras[0].agrees:
        return check.unknown("the gyroscope does not agree with the images")
    delay_ms, sigma_ms = 1e3 * fit.delay_s, 1e3 * fit.delay_sigma_s
    later = "after" if delay_ms >= 0.0 else "before"
    observed = f"images were taken {abs(delay_ms):.1f} +- {sigma_ms:.1f} ms {later} their stamps"
    if sigma_ms > 0.3e3 * _DELAY_S and abs(delay_ms) < _SIGMAS * sigma_ms:
        return check.unknown(f"{observed}: too little change of the turn")
    total_ns = models[0].time_offset_ns + round(fit.delay_s * 1e9)
    remedy = (
        f"time_offset_ns: {total_ns} in sensors.yaml (kalibr: timeshift_cam_imu), or "
        f"--imu_to_camera_time_offset_ns={total_ns}"
    )
    is_sure = abs(delay_ms) > _SIGMAS * sigma_ms
    if is_sure and abs(fit.delay_s) > _DELAY_S:
        return check.wrong(observed, remedy)
    if is_sure and abs(fit.delay_s) > _NOTED_DELAY_S:
        return check.note(observed, remedy)
    return check.ok(observed)


def check_mounting(cameras: Sequence[CameraTurns]) -> Iterator[Finding]:
    """Yield a finding on the rotation of the extrinsics of each camera."""
    for row, camera in enumerate(cameras):
        name = f"rotation of the extrinsics, camera {row}"
        check = Check(name, "that of the calibration, to 2.5 deg")
        if camera.hand_eye is None or not camera.agrees:
            yield check.unknown("the gyroscope does not agree with the images")
            continue
        error = np.degrees(camera.mounting_error)
        sigma = np.degrees(camera.hand_eye.turn_sigma)
        angle = float(np.linalg.norm(error))
        along = float(np.linalg.norm(sigma * error) / max(angle, 1e-9))
        observed = f"off by {angle:.1f} +- {along:.1f} deg"
        if along > _MOUNTING_DEG:
            yield check.unknown(f"{observed}: turn about all axes")
        elif angle > max(_MOUNTING_DEG, _SIGMAS * along) and camera.is_better_than_held(TURN):
            turn = ", ".join(f"{value:.1f}" for value in error)
            remedy = (
                f"T_B_C (kalibr: T_cam_imu) of camera {row} is to be turned by ({turn}) deg in the camera's "
                "frame: --apply writes it, or --vio_estimate=extrinsics"
            )
            yield check.wrong(observed, remedy)
        else:
            yield check.ok(observed)


def scale_of(camera: CameraTurns) -> float | None:
    """Return the scale of the gyroscope by a camera, if it is sure to be off; None if it is not."""
    fit = camera.hand_eye
    if fit is None or not camera.agrees:
        return None
    is_off = abs(fit.scale - 1.0) > max(_SCALE, _SIGMAS * fit.scale_sigma)
    return fit.scale if is_off and camera.is_better_than_held(SCALE) else None


def check_scale(cameras: Sequence[CameraTurns]) -> Finding:
    """Return a finding on the scale of the gyroscope; cameras that differ say that one of them is wrong."""
    check = Check("scale of the gyroscope", "1 +- 0.06")
    fits = [c.hand_eye for c in cameras if c.hand_eye is not None and c.agrees]
    if not fits:
        return check.unknown("the gyroscope does not agree with the images")
    observed = ", ".join(f"{fit.scale:.3f} +- {fit.scale_sigma:.3f}" for fit in fits)
    scales = [scale_of(camera) for camera in cameras]
    if scales[0] is None or (len(fits) > 1 and any(scale is None for scale in scales)):
        return check.ok(observed)
    remedy = f"T_g of the IMU in sensors.yaml: {fits[0].scale:.3f} on its diagonal"
    if len(fits) == 1:
        remedy += f", or the focal length is off: times {1.0 / fits[0].scale:.3f}"
    return check.wrong(observed, remedy)


def check_shutter(cameras: Sequence[CameraTurns], models: Sequence[Camera]) -> Iterator[Finding]:
    """Yield a finding on each camera that seems to have a rolling shutter."""
    for row, (camera, model) in enumerate(zip(cameras, models, strict=True)):
        fit = camera.hand_eye
        known_s = 1e-9 * model.line_delay_ns * model.height_px
        expected = f"readout of {1e3 * known_s:.3g} ms" if known_s else "all rows at once"
        check = Check(f"shutter of camera {row}", expected)
        if fit is None or not camera.agrees or fit.readout_sigma_s > 0.5 * _READOUT_S:
            yield check.unknown("the gyroscope does not tell")
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
            yield check.note(observed, remedy)
        else:
            yield check.ok(observed)
