"""Build the least-squares problem of a map.

The problem uses every observation of every landmark except gross outliers: observations behind the
camera, with a reprojection error above a gate, or of landmarks with fewer than two inliers. Landmarks
of bad quality are used too: on recorded maps most of them merely have few observers and improve the
estimate once gross outliers are rejected.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.algorithms.vi_optimization import data_selection, fixed_states, linear_solver
from maplab_py.algorithms.vi_optimization.calibration_states import (
    RigCameras,
    parameter_count,
    rig_cameras,
)
from maplab_py.algorithms.vi_optimization.factor_terms import (
    MapFactors,
    factor_terms,
    landmark_prior,
    prior_terms,
)
from maplab_py.algorithms.vi_optimization.options import (
    DataOptions,
    FixedStates,
    VIOptimizationOptions,
)
from maplab_py.algorithms.vi_optimization.outliers import OutlierRejection
from maplab_py.array_types import I64, NDArray
from maplab_py.distinct import distinct
from maplab_py.errors import EstimationError, UserError
from maplab_py.estimation.codegen.kernels import visual_kernels
from maplab_py.estimation.imu.inertial_data import motion_at_vertices
from maplab_py.estimation.loss import Loss
from maplab_py.estimation.problem.problem import Problem
from maplab_py.estimation.states import (
    ACCEL_BIAS,
    GYRO_BIAS,
    NODES_PER_VERTEX,
    ORIENTATION,
    POSITION,
    VELOCITY,
    States,
)
from maplab_py.estimation.terms import cameras, protocol
from maplab_py.estimation.terms.extension import REGISTERED, ExpressionTerm, ResidualRows
from maplab_py.estimation.terms.visual import VisualTerms
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import VIMap


def extension_terms(
    vi_map: VIMap, selection: data_selection.Selection, options: DataOptions, progress: Progress
) -> list[ExpressionTerm]:
    """Return the terms of measurements at the selected vertices.

    Raises:
        UserError: There is no residual of that name, or its rows do not fit.
    """
    terms = []
    for name in filter(None, (part.strip() for part in options.residuals.split(","))):
        if name not in REGISTERED:
            known = ", ".join(sorted(REGISTERED)) or "none"
            raise UserError(
                f"--ba_residuals: no plugin has a residual '{name}'; there are: {known}"
            )
        definition = REGISTERED[name]
        rows = definition.rows_of(vi_map)
        vertices = selection.rows(rows.vertices)
        inside = (vertices >= 0).all(axis=1)
        if not inside.any():
            continue
        sigma = np.asarray(rows.sigma, dtype=np.float64)
        if sigma.ndim == 2:
            sigma = sigma[inside]
        chosen = ResidualRows(vertices[inside], rows.data[inside], sigma)
        terms.append(ExpressionTerm(definition, definition.kernel(progress), chosen))
    return terms


@dataclasses.dataclass(frozen=True, eq=False)
class MapTerms:
    """States and terms of a map, from which a problem is built."""

    vi_map: VIMap
    selection: data_selection.Selection
    states: States
    visual: VisualTerms | None
    rejection: OutlierRejection | None
    rig: RigCameras | None
    factors: MapFactors
    terms: tuple[protocol.FactorTerm, ...]  # terms of `factors`, priors and plugins

    def map_problem(self, problem: Problem, held: I64, gauge: str) -> MapProblem:
        """Return the problem of these terms with the data needed to apply its solution to the map."""
        return MapProblem(**vars(self), problem=problem, held=held, gauge=gauge)


@dataclasses.dataclass(frozen=True, eq=False)
class MapProblem(MapTerms):
    """Optimisation problem of a map with the data needed to apply its solution to the map."""

    problem: Problem
    held: I64  # vertices that nothing constrains
    gauge: str


def build(
    vi_map: VIMap,
    options: VIOptimizationOptions,
    *,
    missions: NDArray[np.integer] | None = None,
    fixed_vertices: I64 | None = None,
    progress: Progress = SILENT,
) -> MapProblem:
    """Build the problem of some missions (rows, None = all); some vertices (rows) may be fixed.

    Raises:
        UserError: Flags contradict each other.
        EstimationError: Nothing can be optimised.
        MapError: Calibrations that the terms need are missing.
    """
    parts = collect_terms(vi_map, options, missions=missions, progress=progress)
    states = parts.states
    problem = linear_solver.make_problem(states, parts.visual, parts.terms, options, progress)
    held = fixed_states.hold_unconstrained(problem, states)
    _fix_by_options(problem, options, states, parts.rig)
    fixed = None
    if fixed_vertices is not None:
        fixed = parts.selection.rows(fixed_vertices)
        fixed = fixed[fixed >= 0]
        fixed_states.fix_vertices(problem, fixed)
    gauge = fixed_states.fix_gauge(
        problem,
        states,
        held,
        has_inertial=options.include_inertial,
        has_fixed_landmarks=options.fix_landmark_positions,
        fixed_vertices=fixed,
    )
    return parts.map_problem(problem, held, gauge)


def collect_terms(
    vi_map: VIMap,
    options: VIOptimizationOptions,
    *,
    missions: NDArray[np.integer] | None = None,
    progress: Progress = SILENT,
) -> MapTerms:
    """Return the states and terms of some missions (rows, None = all).

    A caller with more terms or another gauge builds `Problem(parts.states, parts.visual,
    [*parts.terms, *more])`, fixes states, and calls `parts.map_problem`.

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
    selection = data_selection.select(vi_map, options, missions)
    if not len(selection.vertices):
        raise EstimationError("nothing to optimise: the map has no vertices")
    data_selection.check_finite(vi_map, selection, options)
    data_selection.check_metric(vi_map, selection, options)
    states = data_selection.initial_states(vi_map, selection)
    visual, rejection, rig, states = _visual(vi_map, selection, options, states, progress)
    factors = factor_terms(vi_map, selection, options, states, progress)
    states = factors.states
    terms: list[protocol.FactorTerm] = [
        *factors.terms,
        *prior_terms(states, options),
        *extension_terms(vi_map, selection, options, progress),
    ]
    if visual is None and not terms:
        raise EstimationError("nothing to optimise: no landmark observed twice and no usable edge")
    return MapTerms(vi_map, selection, states, visual, rejection, rig, factors, tuple(terms))


def _visual(
    vi_map: VIMap,
    selection: data_selection.Selection,
    options: VIOptimizationOptions,
    states: States,
    progress: Progress,
) -> tuple[VisualTerms | None, OutlierRejection | None, RigCameras | None, States]:
    """Set up the reprojection errors and reject initial gross outliers.

    Landmarks with outliers are triangulated again before the final test.
    """
    if not len(selection.keypoints):
        return None, None, None, states
    used_missions = distinct(vi_map.vertices.mission[selection.vertices]).astype(np.int64)
    rig = rig_cameras(vi_map, used_missions)
    data, sigma_px = data_selection.observations(vi_map, selection, options, rig.first_of_mission)
    calibrating, line_delays = is_calibrating(options), not options.fix_ncamera_line_delay
    visual = VisualTerms(
        visual_kernels(progress),
        data,
        rig.cameras,
        len(selection.vertices),
        loss=Loss[options.loss.upper()],
        move_points=not options.fix_landmark_positions,
        estimate_cameras=calibrating,
        estimate_line_delays=line_delays,
        landmark_prior=landmark_prior(states, options),
    )
    estimated = calibrating + line_delays  # columns of the timing that are states
    if calibrating:
        states = states.with_blocks(
            *cameras.camera_blocks(rig.cameras, rig.timing_s[:, :estimated])
        )
    if rig.is_moving or line_delays or not options.fix_ncamera_time_offset:
        known_s = np.where(np.arange(2) < estimated, 0.0, rig.timing_s)
        known_delay_s = cameras.pixel_delay_s(known_s, data.camera, data.uv_px[:, 1])
        motion = motion_at_vertices(vi_map).of(selection.vertices)
        visual.follow_motion(motion, known_delay_s if known_s.any() else None)
        visual.refresh(states)
    rejection = OutlierRejection(visual, sigma_px, options)
    rejection.gate(states)
    if options.retriangulate_doubtful and not options.fix_landmark_positions:
        doubtful = rejection.doubtful_landmarks()
        rejection.restart()
        fresh = data_selection.retriangulated(vi_map, selection, states, data.start, doubtful)
        states = rejection.better_placed(states, fresh)
        rejection.gate(states)
    visual.refresh(states)
    if not rejection.is_used.any():
        return None, None, None, data_selection.initial_states(vi_map, selection)
    return visual, rejection, rig, states


def is_calibrating(options: FixedStates) -> bool:
    """Return whether something of the cameras is estimated."""
    return not (
        options.fix_ncamera_intrinsics
        and options.fix_ncamera_extrinsics_rotation
        and options.fix_ncamera_extrinsics_translation
        and options.fix_ncamera_time_offset
        and options.fix_ncamera_line_delay
    )


def _fix_by_options(
    problem: Problem, options: FixedStates, states: States, rig: RigCameras | None
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
    if rig is not None and cameras.EXTRINSICS in states.blocks:
        _fix_cameras(problem, options, states, rig)


def _fix_cameras(problem: Problem, options: FixedStates, states: States, rig: RigCameras) -> None:
    extrinsics, intrinsics = states.nodes(cameras.EXTRINSICS), states.nodes(cameras.INTRINSICS)
    for nodes, is_fixed in (
        (extrinsics[:, 0], options.fix_ncamera_extrinsics_translation),
        (extrinsics[:, 1], options.fix_ncamera_extrinsics_rotation),
        (intrinsics.reshape(-1), options.fix_ncamera_intrinsics),
    ):
        if is_fixed:
            problem.fix(nodes)
    is_free = [not options.fix_ncamera_time_offset, not options.fix_ncamera_line_delay, False]
    timing = states.nodes(cameras.TIMING).reshape(-1)
    problem.restrict(
        timing, np.broadcast_to(np.diag(is_free).astype(np.float64), (len(timing), 3, 3))
    )
    is_used = np.arange(3 * intrinsics.shape[1]) < parameter_count(rig)[:, None]
    kept = is_used.reshape(-1, 3)[:, :, None] * np.eye(3)
    problem.restrict(intrinsics.reshape(-1), kept)
