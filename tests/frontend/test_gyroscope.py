"""The turn between frames."""

import dataclasses

import numpy as np
import pytest

from maplab_py.estimation.imu.inertial_data import InertialData
from maplab_py.estimation.imu.preintegration import integrate
from maplab_py.frontend.gyroscope import turn
from maplab_py.frontend.imu_buffer import ImuInterval
from maplab_py.geometry import so3
from maplab_py.sensors import Imu, ImuIntrinsics

T_G = np.array([[1.01, 0.02, -0.01], [0.0, 0.99, 0.015], [0.0, 0.0, 1.02]])


@pytest.mark.parametrize("samples", [2, 3, 8, 11])
@pytest.mark.parametrize("intrinsics", [None, ImuIntrinsics(T_g=T_G)])
def test_it_is_the_turn_of_the_preintegration(
    samples: int, intrinsics: ImuIntrinsics | None
) -> None:
    rng = np.random.default_rng(samples)
    imu = dataclasses.replace(Imu("0" * 32), intrinsics=intrinsics)
    times_ns = np.cumsum(rng.integers(1_000_000, 6_000_000, samples))
    slow = np.linspace(0.0, 1.0, samples)[:, None] * rng.normal(size=6) + rng.normal(size=6)
    interval = ImuInterval(times_ns, slow, 6_000_000)
    bias = rng.normal(scale=0.05, size=3)
    data = InertialData(np.array([0, samples]), times_ns, slow, (imu,), np.zeros(1, dtype=np.int64))
    expected = so3.to_matrix(integrate(data, bias, np.zeros(3)).q_A_B[0])
    np.testing.assert_allclose(turn(imu, interval, bias), expected, atol=1e-6)
