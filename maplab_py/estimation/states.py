"""The states that an optimisation moves, as columns."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.array_types import F64, I64, NDArray
from maplab_py.estimation.blocks import ParameterBlock, ParameterBlocks
from maplab_py.geometry import se3

NODES_PER_VERTEX = 5
"""Nodes of three numbers each: position, orientation, velocity, gyroscope and accelerometer bias.

Eliminating nodes of 3 instead of blocks of 15 lets the ordering separate biases and velocities,
which see only their neighbours in time, from poses, which see all that share landmarks.
"""

POSITION, ORIENTATION, VELOCITY, GYRO_BIAS, ACCEL_BIAS = range(NODES_PER_VERTEX)
NODE_NAMES = ("position", "orientation", "velocity", "gyroscope bias", "accelerometer bias")


def pose_nodes(vertices: NDArray[np.integer]) -> I64:
    """Return the position and orientation nodes (N, 2) of vertices (N,)."""
    base = NODES_PER_VERTEX * vertices.astype(np.int64)
    return np.stack([base + POSITION, base + ORIENTATION], axis=1)


_FAR = 10.0
"""Landmarks beyond so many times the extent of the vertices count as being there."""


@dataclasses.dataclass(frozen=True, eq=False)
class States:
    """States of V vertices and L landmarks, everything in G, and parameters of other kinds.

    Nodes are numbered vertex by vertex (see NODES_PER_VERTEX), then block by block.
    """

    T_G_I: F64  # (V, 7)
    v_G: F64  # (V, 3)
    gyro_bias: F64  # (V, 3)
    accel_bias: F64  # (V, 3)
    p_G: F64  # (L, 3)
    blocks: ParameterBlocks = dataclasses.field(default_factory=ParameterBlocks)

    @property
    def num_vertex_nodes(self) -> int:
        """Nodes of the vertices; those of the blocks follow."""
        return NODES_PER_VERTEX * len(self.T_G_I)

    @property
    def num_nodes(self) -> int:
        """Nodes of vertices and blocks."""
        return self.num_vertex_nodes + self.blocks.num_nodes

    @property
    def node_positions(self) -> F64:
        """Position in G (nodes, 3) of each node's vertex; those of blocks have none, not-a-number."""
        result = np.full((self.num_nodes, 3), np.nan)
        result[: self.num_vertex_nodes] = np.repeat(self.T_G_I[:, 4:], NODES_PER_VERTEX, axis=0)
        return result

    def nodes(self, block: str) -> I64:
        """Return the nodes (N, nodes each) of a block."""
        return self.blocks.nodes(block, self.num_vertex_nodes)

    def with_blocks(self, *blocks: ParameterBlock) -> States:
        """Return the states with further blocks after those they have."""
        return dataclasses.replace(self, blocks=ParameterBlocks([*self.blocks, *blocks]))

    def moved(self, step: F64, p_G: F64) -> States:
        """Apply a step (nodes, 3) and take new landmarks."""
        count = self.num_vertex_nodes
        by_vertex = step[:count].reshape(-1, NODES_PER_VERTEX, 3)
        pose_step = by_vertex[:, [POSITION, ORIENTATION]].reshape(-1, 6)
        return States(
            se3.retract(self.T_G_I, pose_step),
            self.v_G + by_vertex[:, VELOCITY],
            self.gyro_bias + by_vertex[:, GYRO_BIAS],
            self.accel_bias + by_vertex[:, ACCEL_BIAS],
            p_G,
            self.blocks.moved(step[count:]),
        )

    def size(self) -> float:
        """Return the norm of all values, for the relative size of a step.

        Positions are relative to the centre of the vertices.
        """
        centre, p_G = self._centre, self.p_G
        pose = self.T_G_I - np.concatenate([np.zeros(4), centre])
        landmarks = self._landmark_weight * (p_G - centre)
        parts = (pose, self.v_G, self.gyro_bias, self.accel_bias, landmarks)
        return float(np.sqrt(sum(np.sum(part * part) for part in parts) + self.blocks.size2()))

    def step_size(self, step: F64, moved: States) -> float:
        """Return the norm of a step (nodes, 3) together with that of the landmarks, as `size` counts them."""
        landmarks = self._landmark_weight * (moved.p_G - self.p_G)
        return float(np.sqrt(np.sum(step**2) + np.sum(landmarks**2)))

    @property
    def _centre(self) -> F64:
        return np.asarray(self.T_G_I[:, 4:].mean(axis=0)) if len(self.T_G_I) else np.zeros(3)

    @property
    def _landmark_weight(self) -> F64:
        """Weights (L, 1): landmarks far beyond the vertices count in units of their distance.

        Some are nearly at infinity, and their values would otherwise hide those of all other states.
        """
        reach = max(float(np.abs(self.T_G_I[:, 4:] - self._centre).max(initial=0.0)), 1.0)
        distance = np.linalg.norm(self.p_G - self._centre, axis=1, keepdims=True)
        return np.asarray(np.minimum(_FAR * reach / np.maximum(distance, reach), 1.0))
