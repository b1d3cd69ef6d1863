"""Noise of the samples of an IMU, by their residuals: data sheets leave out vibrations."""

import dataclasses

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.estimation.kernels.window_arguments import FRAME_SIZE
from maplab_py.estimation.window.inertial import InertialChain
from maplab_py.estimation.window.states import WindowStates
from maplab_py.sensors import Imu

_LEAST_REDUNDANCY = 5.0
_LEAST_SCATTERED = 50
_APART = 0.5
"""Least interval that counts, as a share of the mean."""
_SIGMA_OF_MEDIAN = 1.4826
_LARGEST_FACTOR = 2.0
_COLUMNS = FRAME_SIZE + 9
_EXAGGERATION, _MARGIN = 10.0, 5.0
"""Accelerometer: largest density, and that used instead, as multiples of the scatter of its samples."""
_LEAST_ACCEL_DENSITY = 0.02
_DOUBTFUL_GYRO_DENSITY, _MOST_GYRO_DENSITY = 7e-5, 7e-4
"""Hardly a gyroscope has less; samples that scatter by more than the other show vibrations."""


def plausible_noise(imu: Imu, times_ns: I64, accel_gyro: F64) -> tuple[Imu, tuple[str, ...]]:
    """Return an IMU with densities that its samples allow, and what was changed.

    Independent noise of a density makes second differences of samples scatter; motion hardly does. The noise
    cannot be much larger than they show.

    Args:
        imu: With the densities of the calibration.
        times_ns: Times (S,) of samples.
        accel_gyro: The samples (S, 6).
    """
    accel, gyro = scatter_density(times_ns, accel_gyro)
    notes = []
    if imu.acc_noise_density > max(_EXAGGERATION * accel, _LEAST_ACCEL_DENSITY):
        density = max(_MARGIN * accel, _LEAST_ACCEL_DENSITY)
        notes.append(
            f"the accelerometer's noise is {imu.acc_noise_density:.2g} m/s^2/sqrt(Hz) by the calibration, "
            f"but its samples scatter by {accel:.2g}: {density:.2g} is used (--vio_imu_noise=file keeps it)"
        )
        imu = dataclasses.replace(imu, acc_noise_density=density)
    density = min(gyro, _MOST_GYRO_DENSITY)
    if imu.gyro_noise_density < min(_DOUBTFUL_GYRO_DENSITY, density):
        notes.append(
            f"the gyroscope's noise is {imu.gyro_noise_density:.2g} rad/s/sqrt(Hz) by the calibration, "
            f"but its samples scatter by {gyro:.2g}: {density:.2g} is used (--vio_imu_noise=file keeps it)"
        )
        imu = dataclasses.replace(imu, gyro_noise_density=density)
    return imu, tuple(notes)


def scatter_density(times_ns: I64, accel_gyro: F64) -> tuple[float, float]:
    """Return the densities of independent noise that samples at about equal intervals scatter by.

    The second difference of independent samples has six times their variance. The largest of the three axes
    counts, and medians over time, so that shocks do not. Of samples that come close together, as where a
    driver has merged those of gyroscope and accelerometer, one counts.
    """
    step_ns = np.diff(times_ns)
    is_apart = np.concatenate([[True], step_ns >= _APART * np.mean(step_ns)])
    times_ns, accel_gyro = times_ns[is_apart], accel_gyro[is_apart]
    step_ns = np.diff(times_ns)
    usual_ns = float(np.median(step_ns))
    is_usual = np.abs(step_ns - usual_ns) < 0.5 * usual_ns
    second = (accel_gyro[2:] - 2.0 * accel_gyro[1:-1] + accel_gyro[:-2])[
        is_usual[1:] & is_usual[:-1]
    ]
    if len(second) < _LEAST_SCATTERED:
        return float("inf"), 0.0
    sigma = _SIGMA_OF_MEDIAN * np.median(np.abs(second), axis=0) / np.sqrt(6.0)
    density = sigma * np.sqrt(usual_ns * 1e-9)
    return float(density[:3].max()), float(density[3:].max())


def with_least_noise(imu: Imu, gyro_density: float, accel_density: float) -> Imu:
    """Return an IMU with densities that are these [rad/s/sqrt(Hz), m/s^2/sqrt(Hz)] or more."""
    return dataclasses.replace(
        imu,
        gyro_noise_density=max(imu.gyro_noise_density, gyro_density),
        acc_noise_density=max(imu.acc_noise_density, accel_density),
    )


def noise_factor(chain: InertialChain, states: WindowStates, covariance: F64) -> float:
    """Return how many times as large as assumed the noise of the samples seems to be.

    It is the root of the weighted sum of squared residuals of the inertial edges over their redundancy, which
    is the number of residuals without those that the states follow. Noise of the images draws it towards 1.
    Source: W. Foerstner, B. Wrobel, Photogrammetric Computer Vision, 2016, section 4.2.4.

    Args:
        chain: The edges between frames.
        states: States of the frames at the optimum.
        covariance: Of them (15 F, 15 F).
    """
    residual, jacobian = chain.evaluate(states.T_M_I, states.motion, slice(None))
    rows = FRAME_SIZE * np.arange(len(residual))[:, None] + np.arange(_COLUMNS)
    of_edges = covariance[rows[:, :, None], rows[:, None, :]]  # (E, 24, 24)
    followed = np.einsum("eij,ejk,eik->", jacobian, of_edges, jacobian, optimize=True)
    redundancy = residual.size - float(followed)
    if redundancy < _LEAST_REDUNDANCY:
        return 1.0
    return min(float(np.sqrt(np.vdot(residual, residual) / redundancy)), _LARGEST_FACTOR)
