"""Inertial edges whose IMUs are calibrated: scale, misalignment and R_A_I are states."""

import dataclasses
from types import ModuleType

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.estimation.blocks import Manifold, ParameterBlock, ParameterBlocks
from maplab_py.estimation.imu import inertial_data, preintegration
from maplab_py.estimation.states import States
from maplab_py.estimation.terms.inertial import FLOOR, InertialTerm, column_major
from maplab_py.geometry import so3, symmetric
from maplab_py.sensors import Imu
from maplab_py.sensors.imu import ImuIntrinsics

GYRO, ACCEL, ROTATION = "gyroscope intrinsics", "accelerometer intrinsics", "R_A_I"
_ROWS, _COLS = np.array([0, 1, 2, 0, 0, 1]), np.array([0, 1, 2, 1, 2, 2])


def triangular(values: F64) -> F64:
    """Return the upper-triangular matrices (..., 3, 3) of [00, 11, 22, 01, 02, 12] (..., 6)."""
    matrices = np.zeros((*values.shape[:-1], 3, 3))
    matrices[..., _ROWS, _COLS] = values
    return matrices


def imu_blocks(imus: tuple[Imu, ...]) -> tuple[ParameterBlock, ...]:
    """Return the blocks of K IMUs at their present calibration (Schneider 2019, eq. 7.7-7.10)."""
    known = [imu.intrinsics or ImuIntrinsics() for imu in imus]
    gyro = np.array([intrinsics.T_g[_ROWS, _COLS] for intrinsics in known]).reshape(-1, 6)
    accel = np.array([intrinsics.T_a[_ROWS, _COLS] for intrinsics in known]).reshape(-1, 6)
    rotation = so3.from_matrix(
        np.array([intrinsics.R_A_I for intrinsics in known]).reshape(-1, 3, 3)
    )
    return (
        ParameterBlock(GYRO, gyro),
        ParameterBlock(ACCEL, accel),
        ParameterBlock(ROTATION, rotation, Manifold.ROTATION),
    )


def intrinsics_of(blocks: ParameterBlocks) -> tuple[ImuIntrinsics, ...]:
    """Return the intrinsics that the blocks hold, IMU by IMU."""
    gyro, accel = triangular(blocks[GYRO].values), triangular(blocks[ACCEL].values)
    rotation = so3.to_matrix(blocks[ROTATION].values)
    return tuple(map(ImuIntrinsics, gyro, accel, rotation))


class CalibratingInertialTerm(InertialTerm):
    """Preintegrated edges over states that have the blocks of `imu_blocks`.

    The samples are integrated again for every value of the intrinsics, so costs are exact; weights
    change only when the solver linearises.
    """

    def __init__(
        self,
        kernel: ModuleType,
        data: inertial_data.InertialData,
        first: I64,
        second: I64,
        g_G: F64,
        states: States,
    ) -> None:
        """Join vertices first (E,) and second (E,) by the edges of `data`."""
        super().__init__(kernel, data, first, second, g_G)
        nodes = [states.nodes(name)[data.imu_of_edge] for name in (GYRO, ACCEL, ROTATION)]
        self.nodes = np.concatenate([self.nodes, *nodes], axis=1)
        self._at: tuple[F64, ...] = ()

    def relinearize(self, states: States) -> bool:
        """Integrate at the present biases and intrinsics, and weigh accordingly."""
        self._biases = states.gyro_bias[self._a], states.accel_bias[self._a]
        covariance = self._integrate_at(states)
        self._whitening = symmetric.lower_whitening(covariance + FLOOR)
        return True

    def evaluate(self, states: States) -> tuple[F64, F64]:
        """Return whitened residuals (E, 9) and Jacobians (E, 9, 39)."""
        if not self._at:
            self.relinearize(states)
        values = tuple(states.blocks[name].values for name in (GYRO, ACCEL, ROTATION))
        if not all(np.array_equal(a, b) for a, b in zip(values, self._at, strict=True)):
            self._integrate_at(states)
        return self._evaluate(states)

    def _integrate_at(self, states: States) -> F64:
        intrinsics = intrinsics_of(states.blocks)
        self._at = tuple(states.blocks[name].values for name in (GYRO, ACCEL, ROTATION))
        imus = tuple(
            dataclasses.replace(imu, intrinsics=values)
            for imu, values in zip(self._data.imus, intrinsics, strict=True)
        )
        data = dataclasses.replace(self._data, imus=imus)
        measured = preintegration.integrate(data, *self._biases, with_intrinsics=True)
        assert measured.jacobian_intrinsics is not None
        self._set_measured(measured, column_major(measured.jacobian_intrinsics))
        return measured.covariance
