"""Figures of noise that the samples contradict."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from maplab_py.frontend.initialization.imu_noise import plausible_noise, scatter_density
from maplab_py.sensors import Imu

Make = Callable[[], tuple[np.ndarray, np.ndarray]]
RATE_HZ, ACCEL, GYRO = 200.0, 2e-3, 1.7e-4
IMU = Imu("imu", acc_noise_density=ACCEL, gyro_noise_density=GYRO)


def samples() -> tuple[np.ndarray, np.ndarray]:
    """Return times and samples of a second of slow motion."""
    rng, count = np.random.default_rng(3), 201
    times_ns = 1_700_000_000_000_000_000 + 5_000_000 * np.arange(count)
    sigma = np.repeat([ACCEL, GYRO], 3) * np.sqrt(RATE_HZ)
    motion = 0.3 * np.sin(2.0 * np.pi * np.arange(count)[:, None] / RATE_HZ)
    return times_ns, motion + sigma * rng.standard_normal((count, 6))


def merged() -> tuple[np.ndarray, np.ndarray]:
    """Return them given twice, 0.2 ms apart."""
    times_ns, values = samples()
    return (times_ns[:, None] + [0, 200_000]).ravel(), np.repeat(values, 2, axis=0)


@pytest.mark.parametrize("make", [samples, merged])
def test_scatter_is_that_of_the_noise(make: Make) -> None:
    accel, gyro = scatter_density(*make())
    assert accel == pytest.approx(ACCEL, rel=0.3)
    assert gyro == pytest.approx(GYRO, rel=0.3)


@pytest.mark.parametrize("make", [samples, merged])
def test_figures_far_off_are_replaced(make: Make) -> None:
    wrong = dataclasses.replace(IMU, acc_noise_density=90.0 * ACCEL, gyro_noise_density=0.1 * GYRO)
    imu, notes = plausible_noise(wrong, *make())
    assert len(notes) == 2
    assert imu.acc_noise_density == pytest.approx(0.02)
    assert imu.gyro_noise_density == pytest.approx(GYRO, rel=0.3)
    assert plausible_noise(IMU, *make()) == (IMU, ())
