"""IMU measurements along a motion (Schneider 2019, section 7) with random-walk biases."""

import numpy as np

from maplab_py.array_types import F64, Rows
from maplab_py.geometry import so3
from maplab_py.sensors import ImuIntrinsics
from maplab_py.simulation.scenario import ImuOptions
from maplab_py.simulation.spline import MotionState


class ImuRecording(Rows):
    """IMU samples and their true biases."""

    accel_gyro: F64  # (N, 6) [ax ay az gx gy gz]
    accel_bias: F64  # (N, 3)
    gyro_bias: F64  # (N, 3)


def intrinsics_of(options: ImuOptions) -> ImuIntrinsics | None:
    """Return scale and misalignment; None when all are ideal."""
    ideal = ImuOptions()
    names = (
        "gyro_scale",
        "accel_scale",
        "gyro_misalignment",
        "accel_misalignment",
        "accel_rotation_rad",
    )
    if all(getattr(options, name) == getattr(ideal, name) for name in names):
        return None
    return ImuIntrinsics(
        T_g=_upper_triangular(options.gyro_scale, options.gyro_misalignment),
        T_a=_upper_triangular(options.accel_scale, options.accel_misalignment),
        R_A_I=so3.to_matrix(so3.exp(options.accel_rotation_rad)),
    )


def _upper_triangular(diagonal: tuple[float, ...], above: tuple[float, ...]) -> F64:
    matrix = np.diag(diagonal).astype(np.float64)
    matrix[[0, 0, 1], [1, 2, 2]] = above
    return matrix


def measure(
    options: ImuOptions,
    intrinsics: ImuIntrinsics,
    motion: MotionState,
    rng: np.random.Generator,
) -> ImuRecording:
    """Return the IMU measurements at the times of a motion, 1 / rate_hz apart.

    Schneider 2019, eq. (7.7)-(7.11): w~ = T_g w + b_g + n_g,
    a~ = T_a R_A_I R_I_G (a_G - g_G) + b_a + n_a; then the effects of the options and saturation.
    """
    count = len(motion.v_G)
    rate = options.rate_hz
    force_I = _specific_force(options, motion)
    time = np.arange(count) / options.rate_hz
    warmth = 1.0 + options.warming_scale * -np.expm1(-time / options.warming_time_s)[:, None]
    gyro = warmth * np.einsum("ij,nj->ni", intrinsics.T_g, motion.w_I)
    gyro += options.g_sensitivity * force_I
    accel = warmth * np.einsum("ij,jk,nk->ni", intrinsics.T_a, intrinsics.R_A_I, force_I)
    accel_bias = _bias(count, options.accel_bias_sigma, options.accel_bias_walk, rate, rng)
    gyro_bias = _bias(count, options.gyro_bias_sigma, options.gyro_bias_walk, rate, rng)
    # a density in 1 / sqrt(Hz) sampled at `rate` has the standard deviation density * sqrt(rate)
    accel_noise = options.accel_noise_density * np.sqrt(rate) * rng.standard_normal((count, 3))
    gyro_noise = options.gyro_noise_density * np.sqrt(rate) * rng.standard_normal((count, 3))
    samples = np.concatenate(
        [accel + accel_bias + accel_noise, gyro + gyro_bias + gyro_noise], axis=1
    )
    most = np.repeat([options.saturation_accel_mps2, options.saturation_gyro_radps], 3)
    return ImuRecording(np.clip(samples, -most, most), accel_bias, gyro_bias)


def _specific_force(options: ImuOptions, motion: MotionState) -> F64:
    """Return the specific force (N, 3) at the accelerometer, in I."""
    gravity_G = np.array([0.0, 0.0, -options.gravity_mps2])
    force_I = so3.rotate(so3.inverse(motion.T_G_I[:, :4]), motion.a_G - gravity_G)
    arm = np.asarray(options.lever_arm_m)
    if not arm.any():
        return force_I
    # rigid body: a_A = a_I + alpha x p + w x (w x p)
    turning = np.cross(motion.w_I, np.cross(motion.w_I, arm))
    return np.asarray(force_I + np.cross(motion.alpha_I, arm) + turning)


def _bias(count: int, sigma: float, walk: float, rate: float, rng: np.random.Generator) -> F64:
    """Return a random-walk bias (count, 3) with random start."""
    steps = walk / np.sqrt(rate) * rng.standard_normal((count, 3))
    steps[0] = sigma * rng.standard_normal(3)
    return np.asarray(np.cumsum(steps, axis=0))
