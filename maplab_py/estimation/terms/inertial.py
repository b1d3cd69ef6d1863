"""Inertial edges and the random walk of their biases, as factor terms."""

from types import ModuleType

import numpy as np

from maplab_py.array_types import F64, I64, Mask
from maplab_py.compilation import compiled
from maplab_py.estimation.imu.inertial_data import InertialData
from maplab_py.estimation.imu.preintegration import Preintegrated, integrate
from maplab_py.estimation.loss import Loss
from maplab_py.estimation.states import (
    ACCEL_BIAS,
    GYRO_BIAS,
    NODES_PER_VERTEX,
    ORIENTATION,
    POSITION,
    VELOCITY,
    States,
)
from maplab_py.estimation.terms.protocol import FixedMeasurements, evaluated
from maplab_py.geometry import symmetric

FLOOR = np.diag([1e-6**2] * 3 + [1e-7**2] * 3 + [1e-6**2] * 3)
"""Added to covariances: edges of a few microseconds stay finite (1 um, 0.1 urad, 1 um/s)."""

TURNED_RAD = 2e-4
SPEEDED_MPS = 2e-3
"""Largest change of an edge by its biases in all before the first-order correction is replaced by
a new integration. The second order is lost until then: 1 nm, 1 nrad and 20 nm/s of a lively 0.2 s."""
_CONVERGED_SHARE = 0.2
_REINTEGRATION_SHARE = 0.1
"""A bias has converged if its last change is at most the first share of its distance from the point of
integration. Then the tolerances above are reduced to the second share, and the error to a hundredth."""


class InertialTerm:
    """Preintegrated edges between vertices.

    Each is integrated again when its bias has moved far, and once more when it has converged.
    """

    name = "inertial"
    loss = (Loss.NONE, 1.0)

    def __init__(
        self, kernel: ModuleType, data: InertialData, first: I64, second: I64, g_G: F64
    ) -> None:
        """Join vertices first (E,) and second (E,) by the edges of `data`; gravity g_G (3,)."""
        self._kernel, self._data, self._g = kernel, data, g_G
        self._a, self._b = first, second
        self._measured: Preintegrated | None = None
        base_a, base_b = NODES_PER_VERTEX * first, NODES_PER_VERTEX * second
        order = (POSITION, ORIENTATION, VELOCITY, GYRO_BIAS, ACCEL_BIAS)
        columns = [base_a + kind for kind in order]
        columns += [base_b + kind for kind in (POSITION, ORIENTATION, VELOCITY)]
        self.nodes = np.stack(columns, axis=1)

    def relinearize(self, states: States) -> bool:
        """Integrate edges again whose biases have changed much; return whether there are any."""
        b_g, b_a = states.gyro_bias[self._a], states.accel_bias[self._a]
        old = self._measured
        if old is None:
            new = integrate(self._data, b_g, b_a)
            self._whitening = whitening(new)
            self._set_measured(new)
            self._seen = np.concatenate([b_g, b_a], axis=1)
            return True
        now = np.concatenate([b_g, b_a], axis=1)
        at = np.concatenate([old.gyro_bias, old.accel_bias], axis=1)
        rows = outdated_edges(now, at, self._seen, old.duration_s)
        self._seen = now
        if not len(rows):
            return False
        new = integrate(self._data.of_edges(rows), b_g[rows], b_a[rows])
        self._whitening = self._whitening.copy()
        self._whitening[rows] = whitening(new)
        self._set_measured(old.updated(rows, new))
        return True

    def _set_measured(self, new: Preintegrated, *more: F64) -> None:
        """Keep the kernel's arguments that do not depend on states."""
        self._measured = new
        self._fixed_arguments = np.concatenate([measured_arguments(new, self._g), *more], axis=1)

    def evaluate(self, states: States) -> tuple[F64, F64]:
        """Return whitened residuals (E, 9) and Jacobians (E, 9, 24)."""
        if self._measured is None:
            self.relinearize(states)
        return self._evaluate(states)

    def _evaluate(self, states: States) -> tuple[F64, F64]:
        a, b = self._a, self._b
        arguments = np.concatenate(
            [
                states.T_G_I[a],
                states.v_G[a],
                states.gyro_bias[a],
                states.accel_bias[a],
                states.T_G_I[b],
                states.v_G[b],
                self._fixed_arguments,
            ],
            axis=1,
        )
        return evaluated(self._kernel, arguments, self._whitening)


class BiasWalkTerm(FixedMeasurements):
    """The change of both biases along an edge: white noise integrated over its duration."""

    name = "bias walk"
    loss = (Loss.NONE, 1.0)

    def __init__(self, first: I64, second: I64, gyro_variance: F64, accel_variance: F64) -> None:
        """Join vertices first (E,) and second (E,); variances (E,) of each component's change."""
        self._a, self._b = first, second
        sigma = np.sqrt(np.stack([gyro_variance, accel_variance], axis=1))
        weight = np.repeat(1.0 / np.maximum(sigma, 1e-9), 3, axis=1)
        self._weight = weight
        kinds = ((first, GYRO_BIAS), (first, ACCEL_BIAS), (second, GYRO_BIAS), (second, ACCEL_BIAS))
        self.nodes = np.stack([NODES_PER_VERTEX * v + kind for v, kind in kinds], axis=1)
        diagonal = weight[:, :, None] * np.eye(6)
        self._jacobian = np.concatenate([-diagonal, diagonal], axis=2)

    def evaluate(self, states: States) -> tuple[F64, F64]:
        """Return whitened residuals (E, 6) and Jacobians (E, 6, 12)."""
        biases = np.concatenate([states.gyro_bias, states.accel_bias], axis=1)
        return (biases[self._b] - biases[self._a]) * self._weight, self._jacobian


def outdated_edges(now: F64, integrated: F64, before: F64, duration_s: F64) -> I64:
    """Return the edges whose biases are too far from those they were integrated at.

    Args:
        now: Biases (E, 6) of gyroscope [rad/s] and accelerometer [m/s^2] at the beginning of edges.
        integrated: Biases at which the edges were integrated.
        before: Biases the last time this was asked, to see which have converged.
        duration_s: Of the edges (E,).
    """
    is_outdated: Mask = np.empty(len(duration_s), dtype=np.bool_)
    _find_outdated(now, integrated, before, duration_s, is_outdated)
    return np.flatnonzero(is_outdated)


@compiled()
def _find_outdated(now, integrated, before, duration_s, is_outdated):  # type: ignore[no-untyped-def]
    """Fill in which edges (E,) are outdated; effects of changed biases are parts of what they may be."""
    for edge in range(len(duration_s)):
        away, change = 0.0, 0.0
        for i in range(6):
            scale = TURNED_RAD if i < 3 else SPEEDED_MPS
            away = max(away, abs(now[edge, i] - integrated[edge, i]) / scale)
            change = max(change, abs(now[edge, i] - before[edge, i]) / scale)
        away, change = away * duration_s[edge], change * duration_s[edge]
        has_converged = change <= _CONVERGED_SHARE * away
        is_outdated[edge] = away > 1.0 or (away > _REINTEGRATION_SHARE and has_converged)


def measured_arguments(measured: Preintegrated, g_G: F64) -> F64:
    """Return the inputs (E, 74) of the inertial residual that do not depend on states."""
    return np.concatenate(
        [
            measured.q_A_B,
            measured.dp,
            measured.dv,
            column_major(measured.jacobian_gyro_bias),
            column_major(measured.jacobian_accel_bias),
            measured.gyro_bias,
            measured.accel_bias,
            measured.duration_s[:, None],
            np.broadcast_to(g_G, (len(measured.dp), 3)),
        ],
        axis=1,
    )


def whitening(measured: Preintegrated) -> F64:
    """Return square roots (E, 9, 9) of the information of preintegrated edges."""
    return symmetric.lower_whitening(measured.covariance + FLOOR)


def column_major(matrices: F64) -> F64:
    """Flatten (E, 9, k) matrices column by column, as casadi orders them."""
    return matrices.transpose(0, 2, 1).reshape(len(matrices), -1)
