"""Reprojection errors of landmarks: data, structure, and calls of the compiled kernels."""

from __future__ import annotations

import dataclasses
from functools import cached_property
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from maplab_py.estimation.loss import Loss, robust
from maplab_py.estimation.states import F64, NODES_PER_VERTEX, States
from maplab_py.estimation.visual_structure import elimination_plan

I64 = NDArray[np.int64]
I32 = NDArray[np.int32]


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

    @cached_property
    def scale2(self) -> F64:
        """Squared loss scale (O,)."""
        return np.square(self.loss_scale)

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

    values: F64  # (4 B, 3, 3) at `node_blocks`
    gradient: F64  # (V, 6) of half the cost
    diagonal: F64  # (V, 6) of the unreduced equations
    cost: float  # half the sum of rho


@dataclasses.dataclass(frozen=True, eq=False)
class NodeSystem:
    """Reduced normal equations by node; the blocks are where `VisualTerms.node_system` was told."""

    gradient: F64  # (nodes, 3)
    diagonal: F64  # (nodes, 3) of the unreduced equations
    cost: float


class VisualTerms:
    """All reprojection errors of a problem."""

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
        """Analyse who sees what together.

        Args:
            kernels: Compiled for the cameras' models.
            observations: Grouped by landmark.
            cameras: As `observations` count them.
            num_vertices: V.
            loss: Robust loss of reprojection errors.
            move_points: Whether landmarks are estimated.
            landmark_prior: Places and inverse standard deviations (L, 4) [m, 1/m]; 0 = none.
        """
        self._kernels = kernels
        self._cameras = cameras
        self._loss = int(loss)
        self._move_points = move_points
        count = len(observations.start) - 1
        self._prior = np.zeros((count, 4)) if landmark_prior is None else landmark_prior
        self.observations = observations
        self._num_vertices = num_vertices
        self.plan = plan = elimination_plan(observations.start, observations.vertex, num_vertices)
        shape = (plan.chunk_start.shape[1] - 1, num_vertices, 6)
        self._Y = np.empty((plan.largest_slab, 3, 6))
        self._square = np.empty((*shape, 6))
        self._gradient, self._diagonal = np.empty(shape), np.empty(shape)

    @property
    def num_chunks(self) -> int:
        """How many sums are kept apart, whatever the number of threads."""
        return len(self._gradient)

    def block_nodes(self, states: States) -> tuple[I64, I64]:  # noqa: ARG002
        """Return node row and column (B,) of every block of the system."""
        return node_blocks(self.plan.rows, self.plan.cols)

    def node_system(self, states: States, damping: float, values: F64) -> NodeSystem:
        """Eliminate the landmarks; what is left goes, by node, to values (B, 3, 3) and the result."""
        system = self.linearize(states.T_G_I, states.p_G, damping, values)
        gradient, diagonal = np.zeros((states.num_nodes, 3)), np.zeros((states.num_nodes, 3))
        pose_part(gradient, states)[:] = system.gradient
        pose_part(diagonal, states)[:] = system.diagonal
        return NodeSystem(gradient, diagonal, system.cost)

    def take_step(
        self, states: States, step: F64, moved: States, damping: float
    ) -> tuple[F64, float, float]:
        """Return landmarks, cost and promised decrease for a step (nodes, 3) to `moved` poses."""
        pose_step = pose_part(step, states)
        return self.step(states.T_G_I, states.p_G, pose_step, moved.T_G_I, damping)

    def refresh(self, states: States) -> bool:  # noqa: ARG002
        """Update what is held constant between calls; tell whether costs have changed."""
        return False

    def errors(self, states: States) -> tuple[F64, F64]:
        """Return reprojection error [px] and depth [m] (O,) of every observation, used or not."""
        return self.reprojection(states.T_G_I, states.p_G)

    def cost(self, states: States) -> float:
        """Return half the sum of rho at some states, without forming any equations."""
        return self.cost_of_errors(self.errors(states)[0], states)

    def cost_of_errors(self, error_px: F64, states: States) -> float:
        """Return the cost at some states for the reprojection errors (O,) that they have."""
        data = self.observations
        used = data.inverse_sigma > 0.0
        squared = np.square(error_px[used] * data.inverse_sigma[used])
        scale2 = data.scale2[used]
        total = float(np.sum(robust(Loss(self._loss), scale2, squared)[0]))
        off = (states.p_G - self._prior[:, :3]) * self._prior[:, 3:]
        return 0.5 * (total + float(np.sum(off * off)))

    @property
    def loss(self) -> Loss:
        """Robust loss of reprojection errors."""
        return Loss(self._loss)

    @property
    def has_landmark_prior(self) -> bool:
        """Whether some landmark has a prior."""
        return bool(self._prior[:, 3].any())

    @property
    def moves_points(self) -> bool:
        """Whether landmarks are estimated."""
        return self._move_points

    def use(self, observations: Observations) -> None:
        """Exchange weights and losses; the structure must be the same."""
        self.observations = observations

    def linearize(
        self, T_G_I: F64, p_G: F64, damping: float, values: F64 | None = None
    ) -> VisualSystem:
        """Eliminate the landmarks at the given states, into values (4 B, 3, 3) if given.

        Gradient and diagonal are reused by the next call.
        """
        if values is None:
            values = np.empty((4 * len(self.plan.cols), 3, 3))
        cost, blocks = np.zeros(self.num_chunks), values.reshape(-1, 6, 6)
        self._clear(values)
        self._kernels.eliminate(
            *self._measured(), T_G_I, self._cameras.T_I_C, self._cameras.parameters, p_G,
            self._prior, self.plan, damping, self._move_points, self._Y, self._square,
            self._gradient, self._diagonal, cost, blocks,
        )  # fmt: skip
        self._kernels.cut_blocks(self.plan, blocks, values)
        return VisualSystem(values, self._gradient[0], self._diagonal[0], 0.5 * float(cost[0]))

    def _clear(self, values: F64) -> None:
        """Set everything that an elimination adds to to zero."""
        for sums in (values, self._square, self._gradient, self._diagonal):
            sums.fill(0.0)

    def step(
        self, T_G_I: F64, p_G: F64, pose_step: F64, new_T_G_I: F64, damping: float
    ) -> tuple[F64, float, float]:
        """Return the new landmarks (L, 3), the new cost and the decrease the model promised."""
        new_p_G, sums = np.empty_like(p_G), np.zeros((self.num_chunks, 2))
        self._kernels.substitute(
            *self._measured(), T_G_I, self._cameras.T_I_C, self._cameras.parameters, p_G,
            self._prior, np.ascontiguousarray(pose_step), damping, self._move_points, self.plan.step_start,
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
        return (
            data.start,
            data.vertex,
            data.camera,
            data.uv_px,
            data.inverse_sigma,
            data.scale2,
            self._loss,
        )


def node_blocks(rows: I64, cols: I64) -> tuple[I64, I64]:
    """Return node row and column of the 3 x 3 parts of pose blocks, (4 B,) each.

    A pose block has the parts (position, orientation) x (position, orientation); of a diagonal
    block the upper part is given the place of the lower one and must carry zeros.
    """
    node_row = NODES_PER_VERTEX * rows[:, None] + np.array([0, 0, 1, 1])
    node_col = NODES_PER_VERTEX * cols[:, None] + np.array([0, 1, 0, 1])
    return np.maximum(node_row, node_col).reshape(-1), np.minimum(node_row, node_col).reshape(-1)


def pose_part(by_node: F64, states: States) -> F64:
    """View the position and orientation nodes of (nodes, 3) as (V, 6)."""
    by_vertex = by_node[: states.num_vertex_nodes].reshape(-1, NODES_PER_VERTEX * 3)
    return by_vertex[:, :6]
