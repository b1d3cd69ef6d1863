"""Reprojection errors whose cameras are estimated: extrinsics, intrinsics and time offset."""

from __future__ import annotations

from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from maplab_py.estimation.blocks import Manifold, ParameterBlock
from maplab_py.estimation.codegen.kernels import camera_columns
from maplab_py.estimation.loss import Loss
from maplab_py.estimation.states import F64, States, pose_nodes
from maplab_py.estimation.visual_terms import (
    Cameras,
    NodeSystem,
    Observations,
    VisualTerms,
    node_blocks,
    pose_part,
)

I64 = NDArray[np.int64]

EXTRINSICS, TIME_OFFSET, INTRINSICS = "camera extrinsics", "camera time offset", "camera intrinsics"


def camera_blocks(cameras: Cameras, time_offset_s: F64) -> tuple[ParameterBlock, ...]:
    """Return the blocks of C cameras, in the order of the kernels' columns."""
    return (
        ParameterBlock(EXTRINSICS, cameras.T_I_C, Manifold.POSE),
        ParameterBlock(TIME_OFFSET, np.asarray(time_offset_s, dtype=np.float64).reshape(-1, 1)),
        ParameterBlock(INTRINSICS, np.ascontiguousarray(cameras.parameters[:, 1:])),
    )


class CalibratingVisualTerms(VisualTerms):
    """Reprojection errors over states that have the blocks of `camera_blocks`.

    What shall not move is fixed in the problem; columns beyond a camera's own parameters are
    padding, without effect, and have to be fixed too (`unused_parameters`).
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
        landmark_prior: F64 | None = None,
    ) -> None:
        """Analyse who sees what together, and by which camera; see `VisualTerms`."""
        super().__init__(
            kernels,
            observations,
            cameras,
            num_vertices,
            loss=loss,
            move_points=move_points,
            landmark_prior=landmark_prior,
        )
        count, width = len(cameras.T_I_C), camera_columns(cameras.parameters.shape[1] - 1)
        self._model = cameras.parameters[:, :1]
        self._border = np.empty((self.num_chunks, count, num_vertices, width, 6))
        self._camera_square = np.empty((self.num_chunks, count, count, width, width))
        self._camera_gradient = np.empty((self.num_chunks, count, width))
        self._camera_diagonal = np.empty((self.num_chunks, count, width))
        self._uv_motion = np.zeros((len(observations), 2))
        self._angular_velocity: F64 | None = None

    def follow_motion(self, angular_velocity_I: F64) -> None:
        """Take time offsets into account, with angular velocities (V, 3) [rad/s] of the vertices.

        The pixels' velocities are those of the states at the latest `refresh`.
        """
        self._angular_velocity = angular_velocity_I

    def refresh(self, states: States) -> bool:
        """Compute the pixels' velocities anew; tell whether there are any."""
        if self._angular_velocity is None:
            return False
        data = self.observations
        tangent = np.concatenate([states.v_G, self._angular_velocity], axis=1)
        self._kernels.pixel_motion(
            data.start, data.vertex, data.camera, data.uv_px, states.T_G_I,
            *self._calibration(states), states.p_G, tangent, self._uv_motion,
        )  # fmt: skip
        self._uv_motion[~np.isfinite(self._uv_motion).all(axis=1)] = 0.0
        return True

    def camera_nodes(self, states: States) -> I64:
        """Return the nodes (C, n) of each camera, in the order of the kernels' columns."""
        names = (EXTRINSICS, TIME_OFFSET, INTRINSICS)
        return np.concatenate([states.nodes(name) for name in names], axis=1)

    def block_nodes(self, states: States) -> tuple[I64, I64]:
        """Return node row and column (B,) of every block of the system."""
        row, col = node_blocks(self.plan.rows, self.plan.cols)
        nodes = self.camera_nodes(states)
        poses = pose_nodes(np.arange(len(states.T_G_I)))
        border_row = np.broadcast_to(nodes[:, None, :, None], (*self._border_shape(nodes), 2))
        border_col = np.broadcast_to(poses[None, :, None, :], border_row.shape)
        square_row, square_col = self._square_places(nodes)
        rows = [row, border_row.reshape(-1), square_row]
        return np.concatenate(rows), np.concatenate([col, border_col.reshape(-1), square_col])

    def _border_shape(self, nodes: I64) -> tuple[int, int, int]:
        return len(nodes), self._num_vertices, nodes.shape[1]

    @staticmethod
    def _square_places(nodes: I64) -> tuple[I64, I64]:
        """Return the lower places among all camera nodes."""
        flat = nodes.reshape(-1)
        row, col = np.nonzero(flat[:, None] >= flat[None, :])
        return flat[row], flat[col]

    def node_system(self, states: States, damping: float, values: F64) -> NodeSystem:
        """Eliminate the landmarks; what is left goes, by node, to values (B, 3, 3) and the result."""
        cost, poses = np.zeros(self.num_chunks), values[: 4 * len(self.plan.cols)]
        blocks = poses.reshape(-1, 6, 6)
        self._clear(poses)
        of_cameras = (
            self._border,
            self._camera_square,
            self._camera_gradient,
            self._camera_diagonal,
        )
        for sums in of_cameras:
            sums.fill(0.0)
        self._kernels.eliminate_calibrating(
            *self._measured(), states.T_G_I, *self._calibration(states), states.p_G,
            self._prior, self._uv_motion, states.blocks[TIME_OFFSET].values, self.plan, damping,
            self._move_points, self._Y, self._square, self._gradient, self._diagonal,
            *of_cameras, cost, blocks,
        )  # fmt: skip
        for sums in of_cameras:
            for chunk in sums[1:]:
                sums[0] += chunk
        self._kernels.cut_blocks(self.plan, blocks, poses)
        nodes = self.camera_nodes(states)
        gradient, diagonal = np.zeros((states.num_nodes, 3)), np.zeros((states.num_nodes, 3))
        pose_part(gradient, states)[:] = self._gradient[0]
        pose_part(diagonal, states)[:] = self._diagonal[0]
        gradient[nodes] = self._camera_gradient[0].reshape(*nodes.shape, 3)
        diagonal[nodes] = self._camera_diagonal[0].reshape(*nodes.shape, 3)
        border = self._border[0].reshape(*self._border_shape(nodes), 3, 2, 3)
        by_node = border.transpose(0, 1, 2, 4, 3, 5).reshape(-1, 3, 3)
        values[len(poses) : len(poses) + len(by_node)] = by_node
        values[len(poses) + len(by_node) :] = self._square_values(nodes)
        return NodeSystem(gradient, diagonal, 0.5 * float(cost[0]))

    def _square_values(self, nodes: I64) -> F64:
        count, each = nodes.shape
        square = self._camera_square[0].reshape(count, count, each, 3, each, 3)
        by_node = square.transpose(0, 2, 1, 4, 3, 5).reshape(count * each, count * each, 3, 3)
        flat = nodes.reshape(-1)
        return np.asarray(by_node[np.nonzero(flat[:, None] >= flat[None, :])])

    def take_step(
        self, states: States, step: F64, moved: States, damping: float
    ) -> tuple[F64, float, float]:
        """Return landmarks, cost and promised decrease for a step (nodes, 3) to `moved` poses."""
        new_p_G, sums = np.empty_like(states.p_G), np.zeros((self.num_chunks, 2))
        nodes = self.camera_nodes(states)
        self._kernels.substitute_calibrating(
            *self._measured(), states.T_G_I, *self._calibration(states), states.p_G,
            self._prior, self._uv_motion, states.blocks[TIME_OFFSET].values,
            np.ascontiguousarray(pose_part(step, states)), step[nodes].reshape(len(nodes), -1),
            damping, self._move_points, self.plan.step_start, moved.T_G_I,
            *self._calibration(moved), moved.blocks[TIME_OFFSET].values, new_p_G, sums,
        )  # fmt: skip
        return new_p_G, 0.5 * float(sums[0, 0]), 0.5 * float(sums[0, 1])

    def errors(self, states: States) -> tuple[F64, F64]:
        """Return reprojection error [px] and depth [m] (O,) of every observation, used or not."""
        data, result = self.observations, np.empty((len(self.observations), 2))
        offset = states.blocks[TIME_OFFSET].values[data.camera]
        self._kernels.evaluate(
            data.start, data.vertex, data.camera, data.uv_px - self._uv_motion * offset,
            states.T_G_I, *self._calibration(states), states.p_G, result,
        )  # fmt: skip
        return result[:, 0], result[:, 1]

    def _calibration(self, states: States) -> tuple[F64, F64]:
        """Return extrinsics (C, 7) and parameters (C, 1 + P) of the states."""
        parameters = np.concatenate([self._model, states.blocks[INTRINSICS].values], axis=1)
        return np.ascontiguousarray(states.blocks[EXTRINSICS].values), parameters
