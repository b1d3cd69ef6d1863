"""Reprojection errors of landmarks: data, structure, and calls of the compiled kernels."""

from __future__ import annotations

import dataclasses
from functools import cached_property
from types import ModuleType

import numpy as np

from maplab_py.array_types import F64, I32, I64, NDArray
from maplab_py.estimation.codegen.kernels import camera_columns, visual_kernels
from maplab_py.estimation.imu.inertial_data import VertexMotion
from maplab_py.estimation.kernels import visual_arguments
from maplab_py.estimation.kernels.loss import loss_and_weight
from maplab_py.estimation.kernels.schur_products import KeptSystem, PoseSums
from maplab_py.estimation.linear.supernodal_solver import BlockPlaces, SupernodalCholesky
from maplab_py.estimation.loss import Loss
from maplab_py.estimation.states import NODES_PER_VERTEX, States
from maplab_py.estimation.terms import visual_structure
from maplab_py.estimation.terms.cameras import (
    EXTRINSICS,
    INTRINSICS,
    TIMING,
    Cameras,
    border_places,
    border_values,
    camera_nodes,
    pixel_delay_s,
)
from maplab_py.geometry import se3

_BLOCKS_AT_ONCE = 65_536
_LEAST_DAMPING = 1e-12
"""Damping of a landmark's elimination in a large trust region: with less, the steps of landmarks at
infinity are rounding, which only smaller regions would hold back."""


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
class VisualPlaces:
    """Places of the blocks of the visual terms in a solver's storage."""

    target: visual_arguments.VisualTarget
    border: BlockPlaces | None  # of cameras that are estimated


@dataclasses.dataclass(frozen=True, eq=False)
class NodeSystem:
    """Reduced normal equations by node; the blocks are in the solver's storage."""

    gradient: F64  # (nodes, 3)
    diagonal: F64  # (nodes, 3) of the unreduced equations
    cost: float


class VisualTerms:
    """All reprojection errors of a problem.

    Where cameras are estimated the states have the blocks of `camera_blocks`. What shall not move is
    fixed in the problem; columns beyond a camera's own parameters are padding, without effect, and
    have to be fixed too.
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
        estimate_cameras: bool = False,
        estimate_line_delays: bool = False,
        landmark_prior: F64 | None = None,
    ) -> None:
        """Analyse the covisibility of vertices.

        Args:
            kernels: Those of `visual_kernels`.
            observations: Grouped by landmark.
            cameras: As `observations` count them.
            num_vertices: V.
            loss: Robust loss of reprojection errors.
            move_points: Whether landmarks are estimated.
            estimate_cameras: Whether the cameras' calibration is estimated.
            estimate_line_delays: Whether it includes the time between two rows of a rolling shutter.
            landmark_prior: Places and inverse standard deviations (L, 4) [m, 1/m]; 0 = none.
        """
        self._kernels, self._cameras = kernels, cameras
        self.loss, self.moves_points = loss, move_points
        count = len(observations.start) - 1
        self._prior = np.zeros((count, 4)) if landmark_prior is None else landmark_prior
        self.observations = observations
        self.num_vertices = num_vertices
        self.chunk_start = visual_structure.landmark_chunks(observations.start)
        self.estimates_cameras = estimate_cameras or estimate_line_delays
        self._estimates_line_delays = estimate_line_delays
        self._uv_motion = self._no_motion() if self.estimates_cameras else np.zeros((0, 2))
        self._motion: VertexMotion | None = None
        self._known_delay_s: F64 | None = None

    @cached_property
    def plan(self) -> visual_structure.EliminationPlan:
        """Blocks of the reduced system, which only solvers that form it need.

        Raises:
            NotEnoughMemory: It does not fit.
        """
        data = self.observations
        return visual_structure.elimination_plan(data.start, data.vertex, self.num_vertices)

    def forget_plan(self) -> None:
        """Free the memory of the plan, which is made again on demand."""
        self.__dict__.pop("plan", None)

    @cached_property
    def _Y(self) -> F64:
        return np.empty((self.plan.largest_slab, 3, 6))

    @cached_property
    def _sums(self) -> visual_arguments.VisualSums:
        width = camera_columns(self._cameras.parameters.shape[1] - 1) * self.estimates_cameras
        return visual_arguments.VisualSums.zeros(
            self.num_chunks, self.num_vertices, len(self._cameras.T_I_C), width
        )

    @property
    def num_chunks(self) -> int:
        """Number of sums that are kept apart, whatever the number of threads."""
        return len(self.chunk_start) - 1

    @property
    def has_landmark_prior(self) -> bool:
        """Whether some landmark has a prior."""
        return bool(self._prior[:, 3].any())

    def use(self, observations: Observations) -> None:
        """Exchange weights and losses; the structure must be the same."""
        self.observations = observations

    def follow_motion(self, motion: VertexMotion, known_delay_s: F64 | None = None) -> None:
        """Give pixels other times than those of their vertices.

        The velocities of pixels are those halfway between vertex and pixel, at the states of the latest
        `refresh`: times the delay that is a displacement to second order. Known delays only move the
        measurements.

        Args:
            motion: Of the V vertices.
            known_delay_s: How much later than its vertex each observation (O,) was taken, beside the
                delay that the states have; None = no later.
        """
        self._motion, self._known_delay_s = motion, known_delay_s
        self._uv_motion = self._no_motion()

    def _no_motion(self) -> F64:
        """Return `VisualData.uv_motion` of pixels that stand still."""
        uv_px = self.observations.uv_px
        rows = uv_px[:, 1:] if self._estimates_line_delays else uv_px[:, :0]
        return np.concatenate([np.zeros_like(uv_px), rows], axis=1)

    def refresh(self, states: States) -> bool:
        """Compute the pixels' velocities again; return whether there are any."""
        if self._motion is None:
            return False
        at, vertex = self._at(states), self.observations.vertex
        delay_s = self._timing_delay_s(at) + (
            0.0 if self._known_delay_s is None else self._known_delay_s
        )
        T_G_I, tangent = self._motion.of(vertex).after(
            0.5 * delay_s, states.T_G_I[vertex], states.v_G[vertex]
        )
        data = self._data()._replace(vertex=np.arange(len(vertex), dtype=np.int32))
        self._kernels.pixel_motion(data, at._replace(T_G_I=T_G_I), tangent, self._uv_motion)
        motion = self._uv_motion[:, :2]
        motion[~np.isfinite(motion).all(axis=1)] = 0.0
        return True

    def block_nodes(self, states: States) -> tuple[I32, I32]:
        """Return node row and column (B,) of every block of the system."""
        row, col = node_blocks(self.plan.rows, self.plan.cols)
        if not self.estimates_cameras:
            return row, col
        border_row, border_col = border_places(states)
        rows, cols = np.concatenate([row, border_row]), np.concatenate([col, border_col])
        return rows.astype(np.int32), cols.astype(np.int32)

    def places(self, states: States, solver: SupernodalCholesky) -> VisualPlaces:
        """Find where the blocks lie in the storage of a solver that has analysed them."""
        rows, cols = self.plan.rows, self.plan.cols
        parts = [np.zeros(0, dtype=np.int32)]
        for first in range(0, len(cols), _BLOCKS_AT_ONCE):
            part = slice(first, first + _BLOCKS_AT_ONCE)
            parts.append(solver.places(*node_blocks(rows[part], cols[part])))
        layout = solver.layout
        target = visual_arguments.VisualTarget(
            NODES_PER_VERTEX, np.concatenate(parts), layout.position, layout.column_start,
            layout.leading,
        )  # fmt: skip
        border = BlockPlaces.of(solver, *border_places(states)) if self.estimates_cameras else None
        return VisualPlaces(target, border)

    def linearize(
        self, states: States, damping: float, solver: SupernodalCholesky, places: VisualPlaces
    ) -> NodeSystem:
        """Eliminate the landmarks; add the Schur complement to the solver's matrix and the result."""
        cost = np.zeros(self.num_chunks)
        for sums in self._sums:
            sums.fill(0.0)
        self._kernels.eliminate(
            self._data(), self._at(states), self._prior, self._rule(damping), self.plan, self._Y,
            self._sums, cost, places.target, solver.numbers,
        )  # fmt: skip
        gradient, diagonal = np.zeros((states.num_nodes, 3)), np.zeros((states.num_nodes, 3))
        pose_part(gradient, states)[:] = self._sums.gradient[0]
        pose_part(diagonal, states)[:] = np.einsum("vii->vi", self._sums.square[0])
        if places.border is not None:
            self._add_camera_chunks()
            nodes = camera_nodes(states)
            gradient[nodes] = self._sums.camera_gradient[0].reshape(*nodes.shape, 3)
            diagonal[nodes] = self._sums.camera_diagonal[0].reshape(*nodes.shape, 3)
            places.border.add(solver, border_values(self._sums, nodes))
        return NodeSystem(gradient, diagonal, 0.5 * float(cost[0]))

    def _add_camera_chunks(self) -> None:
        """Add the cameras' sums of all chunks into chunk 0."""
        sums = self._sums
        for part in (sums.border, sums.camera_square, sums.camera_gradient, sums.camera_diagonal):
            for chunk in part[1:]:
                part[0] += chunk

    def keep_jacobians(self, states: States, kept: KeptSystem, sums: PoseSums) -> float:
        """Evaluate all observations and keep their Jacobians; return the cost.

        Cameras must not be estimated.
        """
        cost = np.zeros(self.num_chunks)
        self._kernels.keep_jacobians(
            self._data(), self._at(states), self._prior, int(self.loss), self.chunk_start, kept,
            sums, cost,
        )  # fmt: skip
        return 0.5 * float(cost.sum())

    def take_step(
        self, states: States, step: F64, moved: States, damping: float
    ) -> tuple[F64, float, float]:
        """Return landmarks, cost and promised decrease for a step (nodes, 3) to `moved` states."""
        new_p_G, sums = np.empty_like(states.p_G), np.zeros((self.num_chunks, 2))
        camera_step = np.zeros((len(self._cameras.T_I_C), 0))
        if self.estimates_cameras:
            camera_step = step[camera_nodes(states)].reshape(len(camera_step), -1)
        self._kernels.substitute(
            self._data(), self._at(states), self._prior, self._rule(damping),
            np.ascontiguousarray(pose_part(step, states)), camera_step, self.chunk_start,
            self._at(moved)._replace(p_G=new_p_G), sums,
        )  # fmt: skip
        return new_p_G, 0.5 * float(sums[0, 0]), 0.5 * float(sums[0, 1])

    def errors(self, states: States) -> tuple[F64, F64]:
        """Return reprojection error [px] and depth [m] (O,) of every observation, used or not."""
        data, at, result = self._data(), self._at(states), np.empty((len(self.observations), 2))
        if self.estimates_cameras:
            delay_s = self._timing_delay_s(at)
            data = data._replace(uv_px=data.uv_px - self._uv_motion[:, :2] * delay_s[:, None])
        self._kernels.evaluate(data, at, result)
        return result[:, 0], result[:, 1]

    def _timing_delay_s(self, at: visual_arguments.VisualStates) -> F64:
        """Return how much later than its vertex each observation (O,) was taken, as the states say."""
        return pixel_delay_s(at.timing_s, self.observations.camera, self._uv_motion[:, -1])

    def cost(self, states: States) -> float:
        """Return half the sum of rho at some states, without forming any equations."""
        return self.cost_of_errors(self.errors(states)[0], states)

    def cost_of_errors(self, error_px: F64, states: States) -> float:
        """Return the cost at some states for the reprojection errors (O,) that they have."""
        data = self.observations
        used = data.inverse_sigma > 0.0
        squared = np.square(error_px[used] * data.inverse_sigma[used])
        total = float(np.sum(loss_and_weight(self.loss, data.scale2[used], squared)[0]))
        off = (states.p_G - self._prior[:, :3]) * self._prior[:, 3:]
        return 0.5 * (total + float(np.sum(off * off)))

    def _data(self) -> visual_arguments.VisualData:
        data, uv_px = self.observations, self.observations.uv_px
        if self._known_delay_s is not None:
            uv_px = uv_px - self._uv_motion[:, :2] * self._known_delay_s[:, None]
        return visual_arguments.VisualData(
            data.start,
            data.vertex,
            data.camera,
            uv_px,
            data.inverse_sigma,
            data.scale2,
            self._uv_motion,
        )

    def _at(self, states: States) -> visual_arguments.VisualStates:
        T_I_C, parameters = self._cameras.T_I_C, self._cameras.parameters
        timing_s = np.zeros((len(T_I_C), 1))
        if self.estimates_cameras:
            blocks = states.blocks
            T_I_C = np.ascontiguousarray(blocks[EXTRINSICS].values)
            parameters = np.concatenate([parameters[:, :1], blocks[INTRINSICS].values], axis=1)
            timing_s = blocks[TIMING].values
        return visual_arguments.VisualStates(states.T_G_I, T_I_C, parameters, states.p_G, timing_s)

    def _rule(self, damping: float) -> visual_arguments.VisualRule:
        damping = max(damping, _LEAST_DAMPING) if damping > 0.0 else 0.0
        return visual_arguments.VisualRule(int(self.loss), float(damping), self.moves_points)


def node_blocks(rows: I32, cols: I32) -> tuple[I32, I32]:
    """Return node row and column of the 3 x 3 parts of pose blocks, (4 B,) each.

    A pose block has the parts (position, orientation) x (position, orientation); of a diagonal
    block the upper part is given the place of the lower one and is not added.
    """
    node_row = np.int32(NODES_PER_VERTEX) * rows[:, None] + np.array([0, 0, 1, 1], dtype=np.int32)
    node_col = np.int32(NODES_PER_VERTEX) * cols[:, None] + np.array([0, 1, 0, 1], dtype=np.int32)
    return np.maximum(node_row, node_col).reshape(-1), np.minimum(node_row, node_col).reshape(-1)


def pose_part(by_node: F64, states: States) -> F64:
    """View the position and orientation nodes of (nodes, 3) as (V, 6)."""
    by_vertex = by_node[: states.num_vertex_nodes].reshape(-1, NODES_PER_VERTEX * 3)
    return by_vertex[:, :6]


def compile_kernels() -> None:
    """Compile reprojection for all cameras, of moving images, too."""
    visual, states = sample_terms()
    visual.follow_motion(VertexMotion.still(2), np.zeros(2))
    visual.refresh(states)
    rows, cols = visual.block_nodes(states)
    solver = SupernodalCholesky(rows, cols, states.num_nodes, 3)
    solver.clear()
    visual.linearize(states, 1e-4, solver, visual.places(states, solver))
    visual.take_step(states, np.zeros((states.num_nodes, 3)), states, 1e-4)
    visual.errors(states)


def sample_terms() -> tuple[VisualTerms, States]:
    """Return the terms of a landmark that two vertices see, small enough for compilation."""
    T_G_I = se3.identity(2)
    T_G_I[1, 4] = 1.0
    observations = Observations(
        start=np.array([0, 2], dtype=np.int64),
        vertex=np.array([0, 1], dtype=np.int32),
        camera=np.zeros(2, dtype=np.int32),
        uv_px=np.array([[60.0, 50.0], [40.0, 50.0]]),
        inverse_sigma=np.ones(2),
        loss_scale=np.full(2, 3.0),
    )
    cameras, zero = Cameras(se3.identity(1), np.array([[0.0, 100, 100, 50, 50]])), np.zeros((2, 3))
    states = States(T_G_I, zero, zero, zero, np.array([[0.5, 0.0, 5.0]]))
    return VisualTerms(visual_kernels(), observations, cameras, 2), states
