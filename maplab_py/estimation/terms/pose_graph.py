"""The terms of a pose graph: relative poses, and priors of roll and pitch. Tangents are twists."""

from __future__ import annotations

import dataclasses
from types import ModuleType
from typing import NamedTuple, TypeVar

import numpy as np

from maplab_py.array_types import F64, I64, NDArray, Rows
from maplab_py.estimation.codegen.kernels import pose_graph_kernels
from maplab_py.estimation.symbolic.sources import PoseError

T = TypeVar("T", bound=np.generic)


def _plain(array: NDArray[T]) -> NDArray[T]:
    """Return an array for compiled loops, copied if nobody may write to it, as in maps.

    Loops would be compiled once more for such arrays.
    """
    return np.require(array, requirements=["C", "W"])


class EdgeColumns(NamedTuple):
    """Arguments of the compiled loops: relative poses."""

    first: I64  # (E,) vertex A
    second: I64  # (E,) vertex B
    T_A_B: F64  # (E, 7)
    sqrt_information: F64  # (E, 6, 6)


class RelativePoses(Rows):
    """Measured relative poses between vertices (E edges), all with the same kind of residual e."""

    from_vertex: I64  # (E,) A
    to_vertex: I64  # (E,) B
    T_A_B: F64  # (E, 7)
    sqrt_information: F64  # (E, 6, 6) W of the cost |W e|^2, columns position, orientation
    error: PoseError = PoseError.SPLIT

    @property
    def kernels(self) -> ModuleType:
        """The compiled loops for this kind of residual."""
        return pose_graph_kernels(self.error)

    @property
    def columns(self) -> EdgeColumns:
        """The edges for the compiled loops."""
        return EdgeColumns(
            _plain(self.from_vertex),
            _plain(self.to_vertex),
            _plain(self.T_A_B),
            _plain(self.sqrt_information),
        )

    def followed_by(self, other: RelativePoses) -> RelativePoses:
        """Return these edges and others with the same kind of residual."""
        return RelativePoses(
            np.concatenate([self.from_vertex, other.from_vertex]),
            np.concatenate([self.to_vertex, other.to_vertex]),
            np.concatenate([self.T_A_B, other.T_A_B]),
            np.concatenate([self.sqrt_information, other.sqrt_information]),
            self.error,
        )

    def linearized(self, T_G_I: F64) -> tuple[F64, F64]:
        """Return W e (E, 6) and its derivatives (E, 2, 6, 6) by twists of A and of B: T <- T exp(x)."""
        whitened, jacobian = np.empty((len(self), 6)), np.empty((len(self), 2, 6, 6))
        self.kernels.linearize(_plain(T_G_I), self.columns, whitened, jacobian)
        return whitened, jacobian

    def errors(self, T_G_I: F64) -> F64:
        """Return the whitened residuals W e (E, 6) for vertex poses (V, 7)."""
        return self.linearized(T_G_I)[0]

    def squared_errors(self, T_G_I: F64) -> F64:
        """Return |W e|^2 (E,) for vertex poses (V, 7)."""
        return np.asarray(np.sum(self.errors(T_G_I) ** 2, axis=1))


@dataclasses.dataclass(frozen=True, eq=False)
class TiltPriors:
    """Measured roll and pitch of vertices (N).

    Residual: (R_G_I d)_xy / sigma with d = Log(R_measured^T R), that is the part of the rotation
    away from the measured attitude that is about horizontal axes.
    """

    vertex: I64  # (N,)
    q_G_I: F64  # (N, 4) measured
    sigma_rad: float

    @classmethod
    def of_vertices(cls, vertex: I64, T_G_I: F64, sigma_deg: float) -> TiltPriors:
        """Take the present attitude of vertices as measured."""
        return cls(vertex, T_G_I[vertex, :4], float(np.deg2rad(sigma_deg)))

    @classmethod
    def none(cls) -> TiltPriors:
        """Return priors of no vertex."""
        return cls(np.zeros(0, dtype=np.int64), np.zeros((0, 4)), 1.0)
