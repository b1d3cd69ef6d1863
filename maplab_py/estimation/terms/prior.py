"""Priors on states."""

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.estimation.blocks import Manifold
from maplab_py.estimation.loss import Loss
from maplab_py.estimation.states import (
    ACCEL_BIAS,
    GYRO_BIAS,
    NODE_NAMES,
    NODES_PER_VERTEX,
    VELOCITY,
    States,
    pose_nodes,
)
from maplab_py.estimation.terms.protocol import FixedMeasurements
from maplab_py.geometry import so3


class BlockPrior(FixedMeasurements):
    """Values of some parameters of a block, with their square-root information.

    The residual is W times the tangent vector from the prior to the state.
    """

    loss = (Loss.NONE, 1.0)

    def __init__(
        self,
        states: States,
        block: str,
        values: F64,
        root_information: F64,
        rows: I64 | None = None,
    ) -> None:
        """Tie rows (N,) of a block, None = all, to values (N, size) with W (N, d, d)."""
        self._block, self._values = block, np.asarray(values, dtype=np.float64)
        self._rows = np.arange(len(states.blocks[block])) if rows is None else np.asarray(rows)
        self.name = f"prior of {block}"
        self.nodes = states.nodes(block)[self._rows]
        count, size = len(self._rows), states.blocks[block].dimension
        self._root = np.broadcast_to(root_information, (count, size, size))

    def evaluate(self, states: States) -> tuple[F64, F64]:
        """Return whitened residuals (N, d) and Jacobians (N, d, 3 nodes)."""
        block = states.blocks[self._block]
        reference = np.array(block.values)
        reference[self._rows] = self._values
        difference = block.difference(reference)[self._rows]
        slope = np.tile(np.eye(block.dimension), (len(self._rows), 1, 1))
        if block.manifold is not Manifold.VECTOR:
            slope[:, -3:, -3:] = so3.right_jacobian_inverse(difference[:, -3:])
        jacobian = np.zeros((*difference.shape, 3 * self.nodes.shape[1]))
        jacobian[:, :, : block.dimension] = self._root @ slope
        return np.einsum("nij,nj->ni", self._root, difference), jacobian


class PosePrior(FixedMeasurements):
    """Poses T_G_I (N, 7) of vertices, position and orientation as in `BlockPrior`."""

    name = "pose prior"
    loss = (Loss.NONE, 1.0)

    def __init__(self, vertices: I64, T_G_I: F64, root_information: F64) -> None:
        """Tie vertices (N,) with W (N, 6, 6), rows position [m] then orientation [rad]."""
        self._vertices, self._prior = vertices, T_G_I
        self.nodes = pose_nodes(vertices)
        self._root = np.broadcast_to(root_information, (len(vertices), 6, 6))

    @property
    def determines_poses(self) -> bool:
        """Whether the prior has information on every direction of every pose."""
        return bool(np.all(np.linalg.matrix_rank(self._root) == 6))

    def evaluate(self, states: States) -> tuple[F64, F64]:
        """Return whitened residuals (N, 6) and Jacobians (N, 6, 6)."""
        pose = states.T_G_I[self._vertices]
        turned = so3.log(so3.multiply(so3.inverse(self._prior[:, :4]), pose[:, :4]))
        residual = np.concatenate([pose[:, 4:] - self._prior[:, 4:], turned], axis=1)
        slope = np.tile(np.eye(6), (len(residual), 1, 1))
        slope[:, 3:, 3:] = so3.right_jacobian_inverse(turned)
        return np.einsum("nij,nj->ni", self._root, residual), self._root @ slope


class VertexVectorPrior(FixedMeasurements):
    """Velocities or biases of vertices."""

    loss = (Loss.NONE, 1.0)

    def __init__(self, kind: int, vertices: I64, values: F64, sigma: float) -> None:
        """Tie VELOCITY, GYRO_BIAS or ACCEL_BIAS of vertices (N,) to values (N, 3)."""
        self.name = f"{NODE_NAMES[kind]} prior"
        self._kind, self._vertices, self._values = kind, vertices, values
        self._weight = 1.0 / sigma
        self.nodes = (NODES_PER_VERTEX * vertices.astype(np.int64) + kind)[:, None]
        self._jacobian = np.tile(self._weight * np.eye(3), (len(vertices), 1, 1))

    def evaluate(self, states: States) -> tuple[F64, F64]:
        """Return whitened residuals (N, 3) and Jacobians (N, 3, 3)."""
        columns = {
            VELOCITY: states.v_G,
            GYRO_BIAS: states.gyro_bias,
            ACCEL_BIAS: states.accel_bias,
        }
        change = columns[self._kind][self._vertices] - self._values
        return change * self._weight, self._jacobian
