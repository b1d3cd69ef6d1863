"""Checks of the IMU: units, magnitude, signs, axes, and noise against the figures."""

from collections.abc import Iterator

import numpy as np

from maplab_py.algorithms.recording_check import inertial, rates
from maplab_py.algorithms.recording_check.findings import Check, Finding
from maplab_py.algorithms.recording_check.signals import Signals
from maplab_py.array_types import F64
from maplab_py.sensors import Imu

GRAVITY = 9.81
_ACCEL_UNITS = {
    GRAVITY: "g",
    1.0: "m/s^2",
    GRAVITY / 1000.0: "thousandths of g",
    0.01: "cm/s^2",
    0.001: "mm/s^2",
}
"""Units by m/s^2 that one of them is."""
_UNIT_TOLERANCE, _NOTED = 0.2, 0.11
"""Deviation of the magnitude from g as a share of it: of another unit, and that is noted."""
_WITHOUT_GRAVITY_MPS2 = 3.0
_DISAGREE, _LEAST_SPREAD = 1.3, 0.03
_UNLIKE = 1.2
"""Ratio of the spreads of gravity by two axes of the accelerometer, from which one of them is right."""
_TOO_SMALL, _TOO_LARGE, _LARGE = 6.0, 18.0, 5.0
"""Ratios of noise densities measured and given; larger figures only make an estimate more careful."""
_FASTEST_RADPS = 12.0
_SIGN_SCORE = 0.6


def accel_unit(quiet: inertial.QuietImu | None) -> float:
    """Return the m/s^2 that the unit of the accelerometer is; 1 where it is not known."""
    if quiet is None:
        return 1.0
    size = max(quiet.accel_norm, 1e-9)
    unit = min(_ACCEL_UNITS, key=lambda known: abs(np.log(size * known / GRAVITY)))
    return unit if abs(size * unit / GRAVITY - 1.0) < _UNIT_TOLERANCE else 1.0


def check_magnitude(signals: Signals, quiet: inertial.QuietImu | None) -> Iterator[Finding]:
    """Yield findings on the unit of the accelerometer, on missing values, and on saturation."""
    values = signals.imu.accel_gyro
    for name, part, unit in (
        ("accelerometer", values[:, :3], "m/s^2"),
        ("gyroscope", values[:, 3:], "rad/s"),
    ):
        if len(values) and not np.any(part):
            remedy = "--imu_topic=GYRO,ACCEL joins the topics of gyroscope and accelerometer"
            yield Check(name, unit).hopeless("all values are 0", remedy)
    check = Check("unit of the accelerometer", f"{GRAVITY:g} m/s^2 at rest")
    if quiet is None:
        yield check.unknown("less than a second of samples")
        return
    where = "at rest" if quiet.is_at_rest else "in the quietest seconds"
    observed = f"{quiet.accel_norm:.4g} {where}, {quiet.mean_norm:.4g} at the median"
    unit_mps2 = accel_unit(quiet)
    off = abs(quiet.accel_norm * unit_mps2 / GRAVITY - 1.0)
    if unit_mps2 != 1.0:
        remedy = f"the unit is {_ACCEL_UNITS[unit_mps2]}: multiply accelerations by {unit_mps2:.6g}"
        yield check.wrong(observed, remedy)
    elif 0.0 < quiet.mean_norm < _WITHOUT_GRAVITY_MPS2:
        remedy = "gravity was removed: record the accelerometer itself, not linear acceleration"
        yield check.wrong(observed, remedy)
    elif off >= _UNIT_TOLERANCE:
        remedy = "scale the accelerations, or calibrate the accelerometer (T_a)"
        yield check.wrong(observed, remedy)
    elif off > _NOTED:
        remedy = (
            "a large bias or scale error: let it rest in several attitudes and calibrate it (T_a)"
        )
        yield check.note(observed, remedy)
    else:
        yield check.ok(observed)
    share = float(np.mean(signals.imu.is_saturated)) if len(signals.imu) else 0.0
    if share > 0.001:
        remedy = "a larger range of the IMU, or slower motion"
        yield Check("saturation", "none").note(f"{share:.1%} of the samples", remedy)


def check_gyro_alone(signals: Signals) -> Finding | None:
    """Return a finding if rates are too large for rad/s, where images do not show it."""
    if len(signals.imu) < 10:
        return None
    rate = float(np.median(np.linalg.norm(signals.imu.accel_gyro[:, 3:], axis=1)))
    if rate < _FASTEST_RADPS:
        return None
    remedy = f"the unit is deg/s: multiply rates by {np.pi / 180.0:.7g}"
    check = Check("unit of the gyroscope", f"below {_FASTEST_RADPS:g} rad/s")
    return check.wrong(f"{rate:.3g} at the median", remedy)


def check_accel_axes(
    signals: Signals, accel: F64, camera: rates.CameraTurns
) -> tuple[Finding, bool]:
    """Return a finding on the axes of the accelerometer, and whether they are those of the gyroscope."""
    expected = "gravity stays where it is while the gyroscope turns"
    check = Check("axes of the accelerometer", expected)
    if camera.gyro is None:
        return check.unknown("no images to know the gyroscope's bias from"), False
    fit = inertial.fit_accel_axes(signals.imu.times_ns, accel, camera.gyro.shifted(-camera.bias))
    if fit is None:
        return check.unknown("the recording is too short"), False
    observed = f"its direction spreads by {np.degrees(fit.as_is):.1f} deg"
    if fit.as_is > _DISAGREE * fit.spread and fit.as_is - fit.spread > _LEAST_SPREAD:
        observed += f", {np.degrees(fit.spread):.1f} deg with {axes_text(fit.B)}"
        remedy = f"exchange the axes of the accelerometer: (x, y, z) = {axes_text(fit.B)}, or all opposite"
        return check.wrong(observed, remedy), False
    return check.ok(observed), True


def raw_axes_agree(signals: Signals, accel: F64, camera: rates.CameraTurns) -> bool | None:
    """Return whether the accelerometer agrees with the gyroscope's axes as recorded better than as exchanged.

    Returns:
        None if the recording does not show it.
    """
    if camera.gyro is None:
        return None
    # turned or mirrored along with the gyroscope, as drivers do that have left-handed axes, or not
    gyro, times_ns = camera.gyro.shifted(-camera.bias), signals.imu.times_ns
    fits = [inertial.fit_accel_axes(times_ns, a, gyro) for a in (accel @ camera.axes.T, accel)]
    if fits[0] is None or fits[1] is None:
        return None
    spread, exchanged = fits[0].as_is, fits[1].as_is
    if max(spread, exchanged) < _UNLIKE * min(spread, exchanged):
        return None
    return spread < exchanged


def check_accel_sign(signals: Signals, accel: F64, camera: rates.CameraTurns) -> Finding:
    """Return a finding on the sign of the accelerometer."""
    check = Check("sign of the accelerometer", "+g upwards at rest")
    if camera.gyro is None or camera.hand_eye is None:
        return check.unknown("no turn of images to compare with")
    pose = camera.hand_eye.R_I_C, signals.device.T_I_C[0, 4:]
    gyro = camera.gyro.shifted(-camera.bias)
    rays = camera.rays.later(camera.hand_eye.delay_s)
    fit = inertial.fit_accel_sign(camera.turns, rays, gyro, accel, signals.imu.times_ns, pose)
    if fit is None or abs(fit.score) < max(_SIGN_SCORE, 4.0 * fit.sigma):
        return check.unknown("too little acceleration to tell")
    if fit.score > 0.0:
        return check.ok("accelerations fit the motion of the images")
    observed = "accelerations are opposite to the motion of the images"
    return check.wrong(observed, "change the sign of all accelerations")


def check_noise(
    imu: Imu, quiet: inertial.QuietImu | None, units: tuple[float, float]
) -> Iterator[Finding]:
    """Yield findings on the noise densities; a device that never rests shows only upper bounds of them."""
    if quiet is None:
        return
    for name, key, given, measured, unit in (
        ("accelerometer", "acc_noise_density", imu.acc_noise_density,
         quiet.accel_density * units[0], "m/s^2/sqrt(Hz)"),
        ("gyroscope", "gyro_noise_density", imu.gyro_noise_density,
         quiet.gyro_density * units[1], "rad/s/sqrt(Hz)"),
    ):  # fmt: skip
        check = Check(f"noise of the {name}", f"{given:.2g} as the calibration says")
        observed = f"{measured:.2g} {unit}"
        remedy = f"{key}: {measured:.2g} in the calibration, or --vio_imu_noise=auto"
        if given > _TOO_LARGE * measured:
            yield check.wrong(observed, f"the figure is too large: {remedy}")
        elif not quiet.is_at_rest and measured > given:
            yield check.unknown(f"{observed} at most: it never rests")
        elif measured > _TOO_SMALL * given:
            yield check.wrong(observed, f"the figure is too small: {remedy}")
        elif given > _LARGE * measured:
            yield check.note(observed, f"larger than needed: {remedy}")
        else:
            yield check.ok(observed)


def measured_quiet(signals: Signals) -> inertial.QuietImu | None:
    """Return the figures of the quietest seconds of the recording."""
    if len(signals.imu) < 10:
        return None
    return inertial.quiet_figures(signals.imu.times_ns, signals.imu.accel_gyro)


def axes_text(axes: F64) -> str:
    """Return signed axes as text, as in "(y, -x, z)"."""
    words = []
    for row in axes:
        column = int(np.argmax(np.abs(row)))
        words.append(("-" if row[column] < 0.0 else "") + "xyz"[column])
    return f"({', '.join(words)})"
