"""Pose the least-squares problem of a map.

Every observation of every landmark takes part unless it is a gross outlier: it lies behind its
camera, is off by more than a gate, or its landmark keeps fewer than two. On recorded maps bad
landmarks help once these gates hold, since most of them are only seen from too few places to be
called good.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.vi_optimization.extensions import extension_terms
from maplab_py.algorithms.vi_optimization.gauge import fix_gauge, hold_unconstrained
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.algorithms.vi_optimization.outliers import OutlierRejection
from maplab_py.algorithms.vi_optimization.rig_states import (
    RigCameras,
    parameter_count,
    rig_cameras,
)
from maplab_py.algorithms.vi_optimization.selection import (
    Selection,
    check_finite,
    initial_states,
    observations,
    retriangulated,
    select,
)
from maplab_py.algorithms.vi_optimization.terms import (
    MapFactors,
    factor_terms,
    landmark_prior,
    prior_terms,
)
from maplab_py.errors import EstimationError, UserError
from maplab_py.estimation.camera_terms import (
    EXTRINSICS,
    INTRINSICS,
    TIME_OFFSET,
    CalibratingVisualTerms,
    camera_blocks,
)
from maplab_py.estimation.codegen.kernels import calibrating_kernels, visual_kernels
from maplab_py.estimation.imu.angular_velocity import angular_velocity_at_vertices
from maplab_py.estimation.linear.block_cholesky import BlockCholesky
from maplab_py.estimation.linear.superlu import SuperLUSolver
from maplab_py.estimation.loss import Loss
from maplab_py.estimation.problem import Problem
from maplab_py.estimation.states import (
    ACCEL_BIAS,
    GYRO_BIAS,
    NODES_PER_VERTEX,
    ORIENTATION,
    POSITION,
    VELOCITY,
    States,
)
from maplab_py.estimation.visual_terms import VisualTerms
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import VIMap

I64 = NDArray[np.int64]


@dataclasses.dataclass(frozen=True, eq=False)
class PosedProblem:
    """A map's problem with all that is needed to solve it and to write the result back."""

    vi_map: VIMap
    selection: Selection
    problem: Problem
    states: States
    rejection: OutlierRejection | None
    rig: RigCameras | None
    factors: MapFactors
    held: I64  # vertices that nothing constrains
    gauge: str


def build(
    vi_map: VIMap,
    options: VIOptimizationOptions,
    *,
    missions: NDArray[np.integer] | None = None,
    progress: Progress = SILENT,
) -> PosedProblem:
    """Pose the problem of some missions (rows, None = all).

    Raises:
        UserError: Flags contradict each other.
        EstimationError: Nothing can be optimised.
        MapError: Calibrations that the terms need are missing.
    """
    if options.fix_vertices and not options.absolute_pose_sensor_fix_mission_baseframes:
        raise UserError(
            "--ba_fix_vertices keeps the base frames as well: drop it, or leave "
            "--ba_absolute_pose_sensor_fix_mission_baseframes on"
        )
    selection = select(vi_map, options, missions)
    if not len(selection.vertices):
        raise EstimationError("nothing to optimise: the map has no vertices")
    check_finite(vi_map, selection, options)
    states = initial_states(vi_map, selection)
    visual, rejection, rig, states = _visual(vi_map, selection, options, states, progress)
    factors = factor_terms(vi_map, selection, options, states, progress)
    states = factors.states
    terms = [
        *factors.terms,
        *prior_terms(states, options),
        *extension_terms(vi_map, selection, options, progress),
    ]
    if visual is None and not terms:
        raise EstimationError("nothing to optimise: no landmark observed twice and no usable edge")
    solver = SuperLUSolver if options.linear_solver_type == "superlu" else BlockCholesky
    problem = Problem(states, visual, terms, solver)
    held = hold_unconstrained(problem, states)
    _fix_by_options(problem, options, states, rig)
    gauge = fix_gauge(
        problem,
        states,
        held,
        has_inertial=options.include_inertial,
        has_fixed_landmarks=options.fix_landmark_positions,
    )
    return PosedProblem(vi_map, selection, problem, states, rejection, rig, factors, held, gauge)


def _visual(
    vi_map: VIMap,
    selection: Selection,
    options: VIOptimizationOptions,
    states: States,
    progress: Progress,
) -> tuple[VisualTerms | None, OutlierRejection | None, RigCameras | None, States]:
    """Set up the reprojection errors and reject those that are hopeless from the start.

    Landmarks that would lose observations are triangulated anew before they are judged.
    """
    if not len(selection.keypoints):
        return None, None, None, states
    used_missions = np.unique(vi_map.vertices.mission[selection.vertices]).astype(np.int64)
    rig = rig_cameras(vi_map, used_missions)
    data, sigma_px = observations(vi_map, selection, options, rig.first_of_mission)
    loss, move_points = Loss[options.loss.upper()], not options.fix_landmark_positions
    count, prior = len(selection.vertices), landmark_prior(states, options)
    visual: VisualTerms
    if is_calibrating(options, rig):
        states = states.with_blocks(*camera_blocks(rig.cameras, rig.delay_s))
        kernels = calibrating_kernels(rig.models, progress)
        calibrating = CalibratingVisualTerms(
            kernels,
            data,
            rig.cameras,
            count,
            loss=loss,
            move_points=move_points,
            landmark_prior=prior,
        )
        if rig.delay_s.any() or not options.fix_ncamera_time_offset:
            calibrating.follow_motion(angular_velocity_at_vertices(vi_map)[selection.vertices])
        visual = calibrating
    else:
        kernels = visual_kernels(rig.models, progress)
        visual = VisualTerms(
            kernels,
            data,
            rig.cameras,
            count,
            loss=loss,
            move_points=move_points,
            landmark_prior=prior,
        )
    rejection = OutlierRejection(visual, sigma_px, options)
    rejection.gate(states)
    if options.retriangulate_doubtful and not options.fix_landmark_positions:
        doubtful = rejection.doubtful_landmarks()
        rejection.restart()
        fresh = retriangulated(vi_map, selection, states, data.start, doubtful)
        states = rejection.better_placed(states, fresh)
        rejection.gate(states)
    visual.refresh(states)
    if not rejection.is_used.any():
        return None, None, None, initial_states(vi_map, selection)
    return visual, rejection, rig, states


def is_calibrating(options: VIOptimizationOptions, rig: RigCameras) -> bool:
    """Tell whether the cameras need the kernels that estimate them, or that know delays."""
    return bool(rig.delay_s.any()) or not (
        options.fix_ncamera_intrinsics
        and options.fix_ncamera_extrinsics_rotation
        and options.fix_ncamera_extrinsics_translation
        and options.fix_ncamera_time_offset
    )


def _fix_by_options(
    problem: Problem, options: VIOptimizationOptions, states: States, rig: RigCameras | None
) -> None:
    first = NODES_PER_VERTEX * np.arange(len(states.T_G_I), dtype=np.int64)
    for kind, is_fixed in (
        (POSITION, options.fix_vertices),
        (ORIENTATION, options.fix_vertices),
        (VELOCITY, options.fix_velocity),
        (GYRO_BIAS, options.fix_gyro_bias),
        (ACCEL_BIAS, options.fix_accel_bias),
    ):
        if is_fixed:
            problem.fix(first + kind)
    if rig is not None and EXTRINSICS in states.blocks:
        _fix_cameras(problem, options, states, rig)


def _fix_cameras(
    problem: Problem, options: VIOptimizationOptions, states: States, rig: RigCameras
) -> None:
    extrinsics, intrinsics = states.nodes(EXTRINSICS), states.nodes(INTRINSICS)
    for nodes, is_fixed in (
        (extrinsics[:, 0], options.fix_ncamera_extrinsics_translation),
        (extrinsics[:, 1], options.fix_ncamera_extrinsics_rotation),
        (intrinsics.reshape(-1), options.fix_ncamera_intrinsics),
        (states.nodes(TIME_OFFSET).reshape(-1), options.fix_ncamera_time_offset),
    ):
        if is_fixed:
            problem.fix(nodes)
    is_used = np.arange(3 * intrinsics.shape[1]) < parameter_count(rig)[:, None]
    kept = is_used.reshape(-1, 3)[:, :, None] * np.eye(3)
    problem.restrict(intrinsics.reshape(-1), kept)
