"""Reprojection errors of landmarks: data, structure, and calls of the compiled kernels."""

from __future__ import annotations

import dataclasses
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from maplab_py.estimation.loss import Loss
from maplab_py.estimation.states import F64, NODES_PER_VERTEX
from maplab_py.vimap.table import starts_of_counts

I64 = NDArray[np.int64]
I32 = NDArray[np.int32]

_CHUNKS = 4
"""Landmarks are summed in this many parts, whatever the number of threads (determinism)."""


@dataclasses.dataclass(frozen=True, eq=False)
class Observations:
    """O observations grouped by landmark, vertices ascending within a landmark."""

    start: I64  # (L + 1,) offsets by landmark
    vertex: I32  # (O,) row of the states
    camera: I32  # (O,) row of cameras
    uv_px: F64  # (O, 2)
    inverse_sigma: F64  # (O,) [1/px]; 0 = the observation does not take part
    loss_scale: F64  # (O,) in sigmas

    def __len__(self) -> int:
        return len(self.vertex)

    @property
    def landmark(self) -> I64:
        """Landmark row of every observation (O,)."""
        return np.repeat(np.arange(len(self.start) - 1), np.diff(self.start))

    def switched(self, is_used: NDArray[np.bool_], sigma_px: F64) -> Observations:
        """Return the same observations of which only some (O,) take part."""
        return dataclasses.replace(self, inverse_sigma=np.where(is_used, 1.0 / sigma_px, 0.0))


@dataclasses.dataclass(frozen=True, eq=False)
class Cameras:
    """C cameras as the kernels read them."""

    T_I_C: F64  # (C, 7)
    parameters: F64  # (C, 1 + widest): index of the model, then intrinsics and distortion


@dataclasses.dataclass(frozen=True, eq=False)
class VisualSystem:
    """Reduced normal equations of the poses."""

    blocks: F64  # (B, 6, 6) [row pose, column pose]
    gradient: F64  # (V, 6) of half the cost
    diagonal: F64  # (V, 6) of the unreduced equations
    cost: float  # half the sum of rho


class VisualTerms:
    """All reprojection errors of a problem.

    `pair_row`, `pair_col` (B,) say which vertices each block of the reduced system joins; the
    diagonal block of every vertex is among them.
    """

    def __init__(
        self,
        kernels: ModuleType,
        observations: Observations,
        cameras: Cameras,
        num_vertices: int,
        *,
        loss: Loss = Loss.HUBER,
        move_points: bool = True,
    ) -> None:
        """Analyse who sees what together."""
        self._kernels = kernels
        self._cameras = cameras
        self._loss = int(loss)
        self._move_points = move_points
        self.observations = observations
        self._num_vertices = num_vertices
        counts = np.diff(observations.start)
        self._pair_start = starts_of_counts(counts * (counts + 1) // 2)
        self.pair_row, self.pair_col, self._pair_block, self._diagonal_block = _pairs(
            observations, self._pair_start, num_vertices
        )
        self._chunk_start = _balanced_chunks(counts)
        shape = (_CHUNKS, num_vertices, 6)
        self._blocks = np.empty((_CHUNKS, len(self.pair_row), 6, 6))
        self._gradient, self._diagonal = np.empty(shape), np.empty(shape)

    def use(self, observations: Observations) -> None:
        """Exchange weights and losses; the structure must be the same."""
        self.observations = observations

    def linearize(self, T_G_I: F64, p_G: F64, damping: float) -> VisualSystem:
        """Eliminate the landmarks at the given states. The arrays are reused by the next call."""
        cost = np.empty(_CHUNKS)
        self._kernels.eliminate(
            *self._measured(), T_G_I, self._cameras.T_I_C, self._cameras.parameters, p_G,
            self._pair_start, self._pair_block, self._diagonal_block, damping, self._move_points,
            self._chunk_start, self._blocks, self._gradient, self._diagonal, cost,
        )  # fmt: skip
        return VisualSystem(
            self._blocks[0], self._gradient[0], self._diagonal[0], 0.5 * float(cost[0])
        )

    def step(
        self, T_G_I: F64, p_G: F64, pose_step: F64, new_T_G_I: F64, damping: float
    ) -> tuple[F64, float, float]:
        """Return the new landmarks (L, 3), the new cost and the decrease the model promised."""
        new_p_G, sums = np.empty_like(p_G), np.zeros((_CHUNKS, 2))
        self._kernels.substitute(
            *self._measured(), T_G_I, self._cameras.T_I_C, self._cameras.parameters, p_G,
            np.ascontiguousarray(pose_step), damping, self._move_points, self._chunk_start,
            new_T_G_I, new_p_G, sums,
        )  # fmt: skip
        return new_p_G, 0.5 * float(sums[0, 0]), 0.5 * float(sums[0, 1])

    def reprojection(self, T_G_I: F64, p_G: F64) -> tuple[F64, F64]:
        """Return error [px] and depth [m] (O,) of every observation, used or not."""
        data = self.observations
        result = np.empty((len(data), 2))
        self._kernels.evaluate(
            data.start, data.vertex, data.camera, data.uv_px, T_G_I, self._cameras.T_I_C,
            self._cameras.parameters, p_G, result,
        )  # fmt: skip
        return result[:, 0], result[:, 1]

    def _measured(self) -> tuple[object, ...]:
        data = self.observations
        scale2 = data.loss_scale * data.loss_scale
        return (
            data.start,
            data.vertex,
            data.camera,
            data.uv_px,
            data.inverse_sigma,
            scale2,
            self._loss,
        )


def _pairs(
    observations: Observations, pair_start: I64, num_vertices: int
) -> tuple[I64, I64, I32, I64]:
    """Return row and column vertex of every block, and the block of each pair of observations.

    The pairs of a landmark with n observations are (b, a), a <= b < n, in row order.
    """
    counts = np.diff(observations.start)
    total = int(pair_start[-1])
    b, a = _triangle(int(counts.max(initial=0)))
    within = np.arange(total) - np.repeat(pair_start[:-1], np.diff(pair_start))
    first = np.repeat(observations.start[:-1], np.diff(pair_start))
    row = observations.vertex[first + b[within]].astype(np.int64)
    col = observations.vertex[first + a[within]].astype(np.int64)
    own = np.arange(num_vertices, dtype=np.int64)
    keys = np.concatenate([own * num_vertices + own, row * num_vertices + col])
    places, block = np.unique(keys, return_inverse=True)
    block = np.asarray(block, dtype=np.int64).reshape(-1)
    return (
        places // num_vertices,
        places % num_vertices,
        block[num_vertices:].astype(np.int32),
        block[:num_vertices],
    )


def _triangle(size: int) -> tuple[I64, I64]:
    """Return the index pairs (b, a), a <= b < size, in row order."""
    b, a = np.tril_indices(size)
    return b.astype(np.int64), a.astype(np.int64)


def _balanced_chunks(counts: I64) -> I64:
    """Cut the landmarks into chunks of about equal work."""
    work = np.concatenate([[0.0], np.cumsum(counts * (counts + 8.0))])
    chunks = np.searchsorted(work, np.linspace(0.0, work[-1], _CHUNKS + 1))
    chunks[0], chunks[-1] = 0, len(counts)
    return chunks.astype(np.int64)


def node_blocks(rows: I64, cols: I64) -> tuple[I64, I64]:
    """Return node row and column of the 3 x 3 parts of pose blocks, (4 B,) each.

    A pose block has the parts (position, orientation) x (position, orientation); of a diagonal
    block the upper part is given the place of the lower one and must carry zeros.
    """
    node_row = NODES_PER_VERTEX * rows[:, None] + np.array([0, 0, 1, 1])
    node_col = NODES_PER_VERTEX * cols[:, None] + np.array([0, 1, 0, 1])
    return np.maximum(node_row, node_col).reshape(-1), np.minimum(node_row, node_col).reshape(-1)


def split_blocks(blocks: F64, is_diagonal: NDArray[np.bool_]) -> F64:
    """Cut pose blocks (B, 6, 6) into 3 x 3 parts (4 B, 3, 3) in the order of `node_blocks`."""
    parts = blocks.reshape(-1, 2, 3, 2, 3).transpose(0, 1, 3, 2, 4).copy()
    parts[is_diagonal, 0, 1] = 0.0
    return parts.reshape(-1, 3, 3)
