"""Put the numbers of an optimisation together."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.vi_optimization.outliers import OutlierRejection
from maplab_py.algorithms.vi_optimization.report import (
    MissionReprojection,
    TermReport,
    VIOptimizationReport,
)
from maplab_py.algorithms.vi_optimization.selection import Selection
from maplab_py.estimation import factor_terms
from maplab_py.estimation.problem import Problem
from maplab_py.estimation.solver import SolverSummary
from maplab_py.estimation.states import F64, States
from maplab_py.vimap import VIMap
from maplab_py.vimap.ids import to_hex

I64 = NDArray[np.int64]


def make_report(
    vi_map: VIMap,
    selection: Selection,
    problem: Problem,
    rejection: OutlierRejection | None,
    before_after: tuple[States, States],
    summary: SolverSummary,
    gauge: str,
    held: I64,
) -> VIOptimizationReport:
    """Return the report; times are filled in by the caller."""
    before, after = before_after
    terms = _terms(problem, before, after)
    errors, missions = (np.zeros((0, 2)), np.zeros(0, dtype=np.int64))
    gated = rejected = landmarks = 0
    if problem.visual is not None and rejection is not None:
        used = rejection.is_used
        errors = np.stack(
            [problem.visual.reprojection(s.T_G_I, s.p_G)[0][used] for s in (before, after)], axis=1
        )
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
        vertices_held=len(held),
        landmarks=landmarks,
        observations=len(selection.keypoints),
        observations_not_used=gated,
        observations_rejected=rejected,
        mean_reprojection_before_px=mean[0],
        mean_reprojection_after_px=mean[1],
        median_reprojection_before_px=median[0],
        median_reprojection_after_px=median[1],
        missions=_by_mission(vi_map, errors, missions),
        gauge=gauge,
        seconds_build=0.0,
        seconds_solve=0.0,
        seconds_total=0.0,
    )


def _terms(problem: Problem, before: States, after: States) -> list[TermReport]:
    terms = []
    if problem.visual is not None:
        used = int(np.count_nonzero(problem.visual.observations.inverse_sigma))
        costs = [problem.visual.linearize(s.T_G_I, s.p_G, 0.0).cost for s in (before, after)]
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
