"""Places of one mission that look alike: weigh its closures as those of two missions are weighed.

A closure inside a mission says how far odometry has drifted between two visits. Closures that join
floors that look alike agree with each other, too: on a drift by the height of a floor. Where other
closures show that odometry has hardly drifted, such a group competes with them, and loses when they
explain significantly more of the trajectory, or when it lets two visits coincide whose landmarks
never match. Without other closures there is nothing to compare, and the group stays.

A stretch that was visited once has no closure of usual drift, but may have one that joins floors.
What only the group explains is therefore compared with the group itself, not with what the others
explain as between missions: 10 to 14 stretches in a building of 180 are enough to exceed the latter.
"""

from __future__ import annotations

import numpy as np

from maplab_py.algorithms.loop_closure.alignment_contest import ContestRule, is_significant
from maplab_py.algorithms.loop_closure.expected_views import is_refuted, unmatched_share
from maplab_py.algorithms.loop_closure.mission_alignment import (
    AgreementRule,
    Alignment,
    MissionPair,
    PairedClosures,
    alignments_of_pairs,
)
from maplab_py.array_types import I64, Mask
from maplab_py.vimap import VIMap

_MIN_STRETCHES = 10
"""Stretches that closures of usual drift must explain before they can refute others."""
_MAX_NEW_SHARE = 1.0 / 3.0
"""Share of its stretches that only a group may explain if it loses."""


def with_places_that_look_alike(
    vi_map: VIMap,
    closures: PairedClosures,
    candidate: Mask,
    is_usual: Mask,
    stretch: I64,
    rule: ContestRule,
) -> Mask:
    """Return which closures (N,) join places of a mission that only look alike.

    Args:
        vi_map: The map.
        closures: Closures, A and B being the same mission for the candidates.
        candidate: Closures (N,) inside missions that passed all other gates.
        is_usual: Closures (N,) that correct no more than odometry usually drifts.
        stretch: Stretch (V,) of each vertex.
        rule: Criteria.
    """
    refused = np.zeros(len(candidate), dtype=np.bool_)
    if not (candidate & ~is_usual).any():
        return refused
    for pair in alignments_of_pairs(closures, candidate, AgreementRule()):
        for rival in _rivals(vi_map, pair, is_usual, stretch, rule):
            refused[rival.rows] = True
    return refused & candidate & ~is_usual


def _rivals(
    vi_map: VIMap, pair: MissionPair, is_usual: Mask, stretch: I64, rule: ContestRule
) -> list[Alignment]:
    """Return the groups of closures that lose against those of usual drift."""
    usual = [a for a in pair.alignments if np.mean(is_usual[a.rows]) > 0.5]
    explained = np.unique(
        np.concatenate([np.zeros(0, dtype=np.int64), *(_stretches(a) for a in usual)])
    )
    if len(explained) < _MIN_STRETCHES:
        return []
    unmatched = min(unmatched_share(vi_map, pair, a, stretch) for a in usual)
    others = [a for a in pair.alignments if np.mean(is_usual[a.rows]) <= 0.5]
    return [
        a
        for a in others
        if _adds_little(_stretches(a), explained, rule)
        or is_refuted(unmatched_share(vi_map, pair, a, stretch), unmatched)
    ]


def _adds_little(group: I64, explained: I64, rule: ContestRule) -> bool:
    """Return whether most stretches of a group, and significantly more others, are explained without it."""
    theirs = len(np.setdiff1d(group, explained))
    ours = len(np.setdiff1d(explained, group))
    return is_significant(ours, theirs, rule) and theirs <= _MAX_NEW_SHARE * len(group)


def _stretches(alignment: Alignment) -> I64:
    return np.union1d(alignment.stretches_A, alignment.stretches_B)
