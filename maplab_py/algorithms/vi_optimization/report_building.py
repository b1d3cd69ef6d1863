"""Build the report of an optimisation."""

from __future__ import annotations

import numpy as np

from maplab_py.algorithms.vi_optimization.calibration_report import calibration_rows
from maplab_py.algorithms.vi_optimization.map_problem import MapProblem
from maplab_py.algorithms.vi_optimization.reports import (
    MissionReprojection,
    TermReport,
    VIOptimizationReport,
)
from maplab_py.array_types import F64, I64
from maplab_py.distinct import distinct
from maplab_py.estimation.problem.problem import Problem
from maplab_py.estimation.problem.solver import SolverSummary
from maplab_py.estimation.states import NODE_NAMES, NODES_PER_VERTEX, States
from maplab_py.estimation.terms import factor as factor_terms
from maplab_py.vimap import VIMap
from maplab_py.vimap.ids import to_hex


def make_report(
    map_problem: MapProblem, after: States, summary: SolverSummary
) -> VIOptimizationReport:
    """Return the report; times are filled in by the caller."""
    vi_map, selection, problem, rejection = (
        map_problem.vi_map, map_problem.selection, map_problem.problem, map_problem.rejection,
    )  # fmt: skip
    before = map_problem.states
    errors_px = (
        [] if problem.visual is None else [problem.visual.errors(s)[0] for s in (before, after)]
    )
    terms = _terms(problem, before, after, errors_px)
    errors, missions = (np.zeros((0, 2)), np.zeros(0, dtype=np.int64))
    gated = rejected = landmarks = 0
    if problem.visual is not None and rejection is not None:
        used = rejection.is_used
        errors = np.stack([error_px[used] for error_px in errors_px], axis=1)
        observing = vi_map.keypoint_vertex[selection.keypoints[used]]
        missions = vi_map.vertices.mission[observing].astype(np.int64)
        gated, rejected = rejection.gated, rejection.rejected
        landmarks = int(np.count_nonzero(rejection.used_landmarks()))
    mean, median = _mean_median(errors)
    return VIOptimizationReport(
        cost_before=sum(term.cost_before for term in terms),
        cost_after=_cost(terms),
        terms=terms,
        iterations=summary.iterations,
        rejected_steps=summary.rejected_steps,
        termination=summary.termination,
        recent_decrease_percent=_percent_of_start(summary.recent_decrease, _cost(terms)),
        vertices=len(selection.vertices),
        vertices_held=len(map_problem.held),
        landmarks=landmarks,
        observations=len(selection.keypoints),
        observations_over_limit=selection.left_out.over_limit,
        observations_not_covisible=selection.left_out.not_covisible,
        observations_not_used=gated,
        observations_rejected=rejected,
        mean_reprojection_before_px=mean[0],
        mean_reprojection_after_px=mean[1],
        median_reprojection_before_px=median[0],
        median_reprojection_after_px=median[1],
        missions=_by_mission(vi_map, errors, missions),
        gauge=map_problem.gauge,
        linear_solver=problem.linear_solver,
        linear_iterations=problem.linear_iterations,
        singular_at=[_name_of(map_problem, after, node) for node in summary.singular_at],
        calibration=calibration_rows(map_problem, after),
        chi_square_per_freedom=_chi_square_per_freedom(map_problem, after, errors_px),
        seconds_build=0.0,
        seconds_solve=0.0,
        seconds_total=0.0,
        note=_note(landmarks, len(selection.landmarks)),
        absolute_poses_rejected=map_problem.factors.absolute_poses_rejected,
        trust_region_radius=summary.radius,
    )


def _note(used: int, landmarks: int) -> str:
    """Return a note if most landmarks become bad, else nothing."""
    if 2 * used >= landmarks:
        return ""
    return (
        f"{landmarks - used} of {landmarks} landmarks are bad: fewer than two of their observations could "
        "be used"
    )


def _cost(terms: list[TermReport]) -> float:
    return sum(term.cost_after for term in terms)


def _name_of(map_problem: MapProblem, states: States, node: int) -> str:
    """Return the name of the state of the map that a node of the problem represents."""
    if node >= states.num_vertex_nodes:
        return map_problem.problem.name_of_node(states, node)
    vertex = map_problem.selection.vertices[node // NODES_PER_VERTEX]
    return (
        f"{NODE_NAMES[node % NODES_PER_VERTEX]} of {to_hex(map_problem.vi_map.vertices.id[vertex])}"
    )


def _terms(
    problem: Problem, before: States, after: States, errors_px: list[F64]
) -> list[TermReport]:
    terms = []
    if problem.visual is not None:
        used = int(np.count_nonzero(problem.visual.observations.inverse_sigma))
        both = zip(errors_px, (before, after), strict=True)
        costs = [problem.visual.cost_of_errors(error_px, s) for error_px, s in both]
        terms.append(TermReport("reprojection", used, *costs))
    for term in problem.factors:
        costs = [factor_terms.cost(term, states) for states in (before, after)]
        terms.append(TermReport(term.name, len(term.nodes), *costs))
    return terms


def _mean_median(errors: F64) -> tuple[list[float], list[float]]:
    if not len(errors):
        return [0.0, 0.0], [0.0, 0.0]
    return errors.mean(axis=0).tolist(), np.median(errors, axis=0).tolist()


def _by_mission(vi_map: VIMap, errors: F64, missions: I64) -> list[MissionReprojection]:
    rows = []
    for mission in distinct(missions).tolist():
        mission_errors = errors[missions == mission]
        mean, median = _mean_median(mission_errors)
        name = to_hex(vi_map.missions.id[mission])
        rows.append(MissionReprojection(name, len(mission_errors), *mean, *median))
    return rows


def _chi_square_per_freedom(map_problem: MapProblem, states: States, errors_px: list[F64]) -> float:
    """Return the squared whitened residuals without robust loss per degree of freedom."""
    problem, total, count = map_problem.problem, 0.0, 0
    if problem.visual is not None:
        data = problem.visual.observations
        total += float(np.sum(np.square(errors_px[-1] * data.inverse_sigma)))
        count += 2 * int(np.count_nonzero(data.inverse_sigma))
    for term in problem.factors:
        residual = term.evaluate(states)[0]
        total += float(np.sum(residual**2))
        count += residual.size
    free = problem.degrees_of_freedom()
    if (
        map_problem.rejection is not None
        and problem.visual is not None
        and problem.visual.moves_points
    ):
        free += 3 * int(np.count_nonzero(map_problem.rejection.used_landmarks()))
    return total / (count - free) if count > free else float("nan")


def _percent_of_start(decrease: float, cost: float) -> float:
    """Return a decrease that led to a cost in percent of the cost before it."""
    return 100.0 * decrease / max(cost + decrease, 1e-300)
