"""Relative and absolute pose measurements as factor terms."""

from __future__ import annotations

import dataclasses
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from maplab_py.estimation.loss import Loss
from maplab_py.estimation.states import F64, NODES_PER_VERTEX, ORIENTATION, POSITION, States

I64 = NDArray[np.int64]

_SMALLEST_VARIANCE = 1e-14


def whitening(covariance: F64) -> F64:
    """Return W (N, 6, 6) with W' W = covariance^-1; variances are kept above 1e-14.

    Covariances that are not numbers count as the identity.
    """
    usable = np.isfinite(covariance).all(axis=(1, 2), keepdims=True)
    clean = np.where(usable, covariance, np.eye(6))
    values, vectors = np.linalg.eigh(0.5 * (clean + clean.transpose(0, 2, 1)))
    scale = 1.0 / np.sqrt(np.maximum(values, _SMALLEST_VARIANCE))
    return np.asarray(scale[:, :, None] * vectors.transpose(0, 2, 1))


@dataclasses.dataclass(frozen=True, eq=False)
class RelativePoseTerm:
    """Measured relative poses T_SA_SB of a sensor between two vertices: odometry, loop closures."""

    kernel: ModuleType
    name: str
    first: I64  # (N,) vertex rows
    second: I64  # (N,)
    T_I_S: F64  # (N, 7)
    T_SA_SB: F64  # (N, 7)
    whitening: F64  # (N, 6, 6)
    loss: tuple[Loss, float] = (Loss.NONE, 1.0)

    @property
    def nodes(self) -> I64:
        """Nodes (N, 4)."""
        return np.concatenate([_pose_nodes(self.first), _pose_nodes(self.second)], axis=1)

    def evaluate(self, states: States) -> tuple[F64, F64]:
        """Return whitened residuals (N, 6) and Jacobians (N, 6, 12)."""
        poses = states.T_G_I
        arguments = np.concatenate(
            [poses[self.first], poses[self.second], self.T_I_S, self.T_SA_SB], axis=1
        )
        residual, jacobian = np.empty((len(arguments), 6)), np.empty((len(arguments), 6, 12))
        self.kernel.evaluate(arguments, self.whitening, residual, jacobian)
        return residual, jacobian


@dataclasses.dataclass(frozen=True, eq=False)
class AbsolutePoseTerm:
    """Measured poses T_G_S of a sensor at vertices."""

    kernel: ModuleType
    vertex: I64  # (N,)
    T_I_S: F64  # (N, 7)
    T_G_S: F64  # (N, 7)
    whitening: F64  # (N, 6, 6)
    loss: tuple[Loss, float] = (Loss.NONE, 1.0)
    name: str = "absolute pose"

    @property
    def nodes(self) -> I64:
        """Nodes (N, 2)."""
        return _pose_nodes(self.vertex)

    def evaluate(self, states: States) -> tuple[F64, F64]:
        """Return whitened residuals (N, 6) and Jacobians (N, 6, 6)."""
        arguments = np.concatenate([states.T_G_I[self.vertex], self.T_I_S, self.T_G_S], axis=1)
        residual, jacobian = np.empty((len(arguments), 6)), np.empty((len(arguments), 6, 6))
        self.kernel.evaluate(arguments, self.whitening, residual, jacobian)
        return residual, jacobian


def _pose_nodes(vertices: I64) -> I64:
    base = NODES_PER_VERTEX * vertices.astype(np.int64)
    return np.stack([base + POSITION, base + ORIENTATION], axis=1)
