"""How far recorded closures are from agreeing with the closures nearby."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.algorithms.loop_closure.closure_record import ClosureRecord
from maplab_py.algorithms.loop_closure.closure_table import VERDICTS
from maplab_py.algorithms.loop_closure.consensus import ConsensusRule, check_consensus
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.reports import Verdict
from maplab_py.array_types import F64, I64, Mask
from maplab_py.geometry import se3
from maplab_py.vimap import VIMap

DIFFERENCES = (1.1, 1.25, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 7.0, 10.0, 20.0, 50.0, 100.0, 1000.0)
"""Values of --lc_max_neighbour_difference that are tried; with the last one all closures agree."""


def consensus_of_record(
    vi_map: VIMap, closures: ClosureRecord, options: LoopClosureOptions
) -> tuple[I64, Mask, Mask]:
    """Return support (N,), and which recorded closures are supported and which contradicted (N,)."""
    query, place = (vi_map.vertex_index.rows(ids) for ids in (closures.query, closures.place))
    T_M_I = se3.compose(vi_map.vertices.T_M_I[place], se3.inverse(closures.T_A_B))
    rule = ConsensusRule(
        min_support=options.min_support, max_difference=options.max_neighbour_difference
    )
    return check_consensus(
        vi_map,
        query.astype(np.int64),
        place.astype(np.int64),
        T_M_I,
        closures.inliers.astype(np.int64),
        rule,
    )


def differences(vi_map: VIMap, closures: ClosureRecord, options: LoopClosureOptions) -> F64:
    """Return the smallest of `DIFFERENCES` with which each closure (N,) agrees with those nearby.

    It is 0 for closures that were not refused because closures nearby contradict them. Closures of
    other pairs of missions, which cannot contradict them, do not take part.
    """
    value = np.zeros(len(closures))
    contradicted = closures.verdict == VERDICTS.index(Verdict.CONTRADICTED)
    if not contradicted.any():
        return value
    kinds = (Verdict.CONTRADICTED, Verdict.ACCEPTED, Verdict.NO_SUPPORT)
    pair = _pairs_of_missions(vi_map, closures)
    left = np.flatnonzero(
        np.isin(closures.verdict, [VERDICTS.index(kind) for kind in kinds])
        & np.isin(pair, pair[contradicted])
    )
    compared, refused = closures.take(left), contradicted[left]
    smallest = np.full(len(left), DIFFERENCES[-1])
    for difference in DIFFERENCES[:-1]:
        moved = dataclasses.replace(options, max_neighbour_difference=difference)
        _, _, still = consensus_of_record(vi_map, compared, moved)
        smallest[~still] = np.minimum(smallest[~still], difference)
        if not (still & refused).any():
            break
    value[left[refused]] = smallest[refused]
    return value


def _pairs_of_missions(vi_map: VIMap, closures: ClosureRecord) -> I64:
    query, place = (vi_map.vertex_index.rows(ids) for ids in (closures.query, closures.place))
    mission = vi_map.vertices.mission
    return np.asarray(mission[query].astype(np.int64) * len(vi_map.missions) + mission[place])
