"""Visual-inertial least squares over a map.

Every observation of every landmark takes part unless it is a gross outlier: it lies behind its
camera, is off by more than a gate, or its landmark keeps fewer than two. On recorded maps bad
landmarks help once these gates hold, since most of them are only seen from too few places to be
called good.
"""

from __future__ import annotations

import dataclasses
import time

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.vi_optimization.gauge import fix_gauge, hold_unconstrained
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.algorithms.vi_optimization.outliers import OutlierRejection
from maplab_py.algorithms.vi_optimization.report import VIOptimizationReport
from maplab_py.algorithms.vi_optimization.reporting import make_report
from maplab_py.algorithms.vi_optimization.selection import (
    Selection,
    cameras,
    initial_states,
    observations,
    retriangulated,
    select,
)
from maplab_py.algorithms.vi_optimization.terms import factor_terms
from maplab_py.errors import EstimationError
from maplab_py.estimation.codegen.kernels import visual_kernels
from maplab_py.estimation.loss import Loss
from maplab_py.estimation.problem import Problem
from maplab_py.estimation.solver import SolverOptions, optimize_states
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
from maplab_py.geometry import se3, so3
from maplab_py.progress import SILENT, Progress, SilentProgress
from maplab_py.vimap import LandmarkQuality, VIMap

I64 = NDArray[np.int64]


def optimize(
    vi_map: VIMap,
    options: VIOptimizationOptions,
    *,
    missions: NDArray[np.integer] | None = None,
    progress: Progress = SILENT,
) -> tuple[VIMap, VIOptimizationReport]:
    """Optimise poses, velocities, biases and landmarks of some missions (rows, None = all).

    Returns:
        The optimised map and a report of costs, reprojection errors and outliers.

    Raises:
        EstimationError: Nothing can be optimised, or the cost is not finite.
        MapError: Calibrations that the terms need are missing.
    """
    began = time.perf_counter()
    selection = select(vi_map, options, missions)
    if not len(selection.vertices):
        raise EstimationError("nothing to optimise: the map has no vertices")
    states = initial_states(vi_map, selection)
    visual, rejection, states = _visual(vi_map, selection, options, states, progress)
    factors = factor_terms(vi_map, selection, options, progress)
    if visual is None and not factors:
        raise EstimationError("nothing to optimise: no landmark observed twice and no usable edge")
    problem = Problem(len(selection.vertices), visual, factors)
    held = hold_unconstrained(problem, len(selection.vertices))
    _fix_by_options(problem, options, len(selection.vertices))
    gauge = fix_gauge(problem, states, held, has_inertial=options.include_inertial)
    built = time.perf_counter()
    quiet = options.hide_iterations_console_output
    final, summary = optimize_states(
        problem,
        states,
        _solver_options(options),
        _Quiet(progress) if quiet else progress,
        rejection.after_step if rejection is not None else None,
    )
    result = _written_back(vi_map, selection, final, rejection)
    report = make_report(
        vi_map, selection, problem, rejection, (states, final), summary, gauge, held
    )
    solved = time.perf_counter()
    return result, dataclasses.replace(
        report,
        seconds_build=built - began,
        seconds_solve=summary.seconds,
        seconds_total=solved - began,
    )


class _Quiet(SilentProgress):
    """Passes on cancellation only."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress

    def check(self) -> None:
        """Raise Cancelled when the user wants to stop."""
        self._progress.check()


def _visual(
    vi_map: VIMap,
    selection: Selection,
    options: VIOptimizationOptions,
    states: States,
    progress: Progress,
) -> tuple[VisualTerms | None, OutlierRejection | None, States]:
    """Set up the reprojection errors and reject those that are hopeless from the start.

    Landmarks that would lose observations are triangulated anew before they are judged.
    """
    if not len(selection.keypoints):
        return None, None, states
    used_missions = np.unique(vi_map.vertices.mission[selection.vertices]).astype(np.int64)
    rig, models, first_camera = cameras(vi_map, used_missions)
    kernels = visual_kernels(models, progress)
    data, sigma_px = observations(vi_map, selection, options, first_camera)
    visual = VisualTerms(
        kernels,
        data,
        rig,
        len(selection.vertices),
        loss=Loss[options.loss.upper()],
        move_points=not options.fix_landmark_positions,
    )
    rejection = OutlierRejection(visual, sigma_px, options)
    rejection.gate(states)
    if options.retriangulate_doubtful and not options.fix_landmark_positions:
        doubtful = rejection.doubtful_landmarks()
        states = retriangulated(vi_map, selection, states, data.start, doubtful)
        rejection.restart()
        rejection.gate(states)
    if not rejection.is_used.any():
        return None, None, states
    return visual, rejection, states


def _fix_by_options(problem: Problem, options: VIOptimizationOptions, num_vertices: int) -> None:
    first = NODES_PER_VERTEX * np.arange(num_vertices, dtype=np.int64)
    for kind, is_fixed in (
        (POSITION, options.fix_vertices),
        (ORIENTATION, options.fix_vertices),
        (VELOCITY, options.fix_velocity),
        (GYRO_BIAS, options.fix_gyro_bias),
        (ACCEL_BIAS, options.fix_accel_bias),
    ):
        if is_fixed:
            problem.fix(first + kind)


def _solver_options(options: VIOptimizationOptions) -> SolverOptions:
    return SolverOptions(
        num_iterations=options.num_iterations,
        max_time_seconds=options.max_time_seconds,
        initial_radius=options.initial_trust_region_radius,
        max_radius=options.max_trust_region_radius,
        min_radius=options.min_trust_region_radius,
        function_tolerance=options.function_tolerance,
        gradient_tolerance=options.gradient_tolerance,
        parameter_tolerance=options.parameter_tolerance,
    )


def _written_back(
    vi_map: VIMap, selection: Selection, states: States, rejection: OutlierRejection | None
) -> VIMap:
    """Return the map with the new states; landmarks return to their vertices' frames.

    Landmarks that did not take part move with the vertex that stores them.
    """
    rows = selection.vertices
    T_G_M = vi_map.T_G_M[vi_map.vertices.mission[rows]]
    columns = {
        name: np.array(getattr(vi_map.vertices, name))
        for name in ("T_M_I", "v_M", "gyro_bias", "accel_bias")
    }
    columns["T_M_I"][rows] = se3.relative(T_G_M, states.T_G_I)
    columns["v_M"][rows] = so3.rotate(so3.inverse(T_G_M[:, :4]), states.v_G)
    columns["gyro_bias"][rows] = states.gyro_bias
    columns["accel_bias"][rows] = states.accel_bias
    vertices = vi_map.vertices.replace(**columns)
    if rejection is None:
        return vi_map.replace(vertices=vertices)
    p_I, quality = np.array(vi_map.landmarks.p_I), np.array(vi_map.landmarks.quality)
    alive = rejection.used_landmarks()
    landmarks = selection.landmarks[alive]
    home = selection.rows(vi_map.landmarks.vertex[landmarks])
    p_I[landmarks] = se3.transform(se3.inverse(states.T_G_I[home]), states.p_G[alive])
    quality[selection.landmarks[~alive]] = LandmarkQuality.BAD
    return vi_map.replace(
        vertices=vertices, landmarks=vi_map.landmarks.replace(p_I=p_I, quality=quality)
    )
