"""Put the numbers of an optimisation together."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.vi_optimization.building import PosedProblem
from maplab_py.algorithms.vi_optimization.calibration_report import calibration_rows
from maplab_py.algorithms.vi_optimization.report import (
    MissionReprojection,
    TermReport,
    VIOptimizationReport,
)
from maplab_py.estimation import factor_terms
from maplab_py.estimation.problem import Problem
from maplab_py.estimation.solver import SolverSummary
from maplab_py.estimation.states import F64, NODE_NAMES, NODES_PER_VERTEX, States
from maplab_py.vimap import VIMap
from maplab_py.vimap.ids import to_hex

I64 = NDArray[np.int64]


def make_report(posed: PosedProblem, after: States, summary: SolverSummary) -> VIOptimizationReport:
    """Return the report; times are filled in by the caller."""
    vi_map, selection, problem, rejection = (
        posed.vi_map, posed.selection, posed.problem, posed.rejection,
    )  # fmt: skip
    before = posed.states
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
        cost_after=sum(term.cost_after for term in terms),
        terms=terms,
        iterations=summary.iterations,
        rejected_steps=summary.rejected_steps,
        termination=summary.termination,
        vertices=len(selection.vertices),
        vertices_held=len(posed.held),
        landmarks=landmarks,
        observations=len(selection.keypoints),
        observations_not_used=gated,
        observations_rejected=rejected,
        mean_reprojection_before_px=mean[0],
        mean_reprojection_after_px=mean[1],
        median_reprojection_before_px=median[0],
        median_reprojection_after_px=median[1],
        missions=_by_mission(vi_map, errors, missions),
        gauge=posed.gauge,
        singular_at=[_name_of(posed, after, node) for node in summary.singular_at],
        calibration=calibration_rows(posed, after),
        chi_square_per_freedom=_chi_square_per_freedom(posed, after, errors_px),
        seconds_build=0.0,
        seconds_solve=0.0,
        seconds_total=0.0,
    )


def _name_of(posed: PosedProblem, states: States, node: int) -> str:
    """Say which state of the map a node of the problem is."""
    if node >= states.num_vertex_nodes:
        return posed.problem.name_of_node(states, node)
    vertex = posed.selection.vertices[node // NODES_PER_VERTEX]
    return f"{NODE_NAMES[node % NODES_PER_VERTEX]} of {to_hex(posed.vi_map.vertices.id[vertex])}"


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
    for mission in np.unique(missions).tolist():
        own = errors[missions == mission]
        mean, median = _mean_median(own)
        name = to_hex(vi_map.missions.id[mission])
        rows.append(MissionReprojection(name, len(own), *mean, *median))
    return rows


def _chi_square_per_freedom(posed: PosedProblem, states: States, errors_px: list[F64]) -> float:
    """Return the squared whitened residuals, no robust loss, per degree of freedom."""
    problem, total, count = posed.problem, 0.0, 0
    if problem.visual is not None:
        data = problem.visual.observations
        total += float(np.sum(np.square(errors_px[-1] * data.inverse_sigma)))
        count += 2 * int(np.count_nonzero(data.inverse_sigma))
    for term in problem.factors:
        residual = term.evaluate(states)[0]
        total += float(np.sum(residual**2))
        count += residual.size
    free = problem.degrees_of_freedom()
    if posed.rejection is not None and problem.visual is not None and problem.visual.moves_points:
        free += 3 * int(np.count_nonzero(posed.rejection.used_landmarks()))
    return total / (count - free) if count > free else float("nan")
