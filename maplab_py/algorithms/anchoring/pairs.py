"""Alignments of pairs of missions: fitted, judged by their own closures, then by each other."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.anchoring.alignment import Sightings, agreeing, fit_missions
from maplab_py.algorithms.anchoring.options import AnchoringOptions
from maplab_py.geometry import yaw

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

USED = "used"
_CYCLE_TOLERANCE = 1.5
"""A cycle may be open by as many times what single closures may differ by: drift adds up."""


@dataclasses.dataclass(frozen=True, eq=False)
class Pair:
    """How two missions lie in each other by their closures."""

    a: int
    b: int
    T_B_A: F64  # yaw and position (4,)
    sightings: Sightings  # that agree with it
    closures: int  # accepted ones between the two
    verdict: str = USED  # or the reason why not

    @property
    def weight(self) -> float:
        """Inliers of all closures that agree."""
        return float(self.sightings.weight.sum())

    @property
    def rms_m(self) -> float:
        """RMS distance of the closures' positions."""
        gap = _gaps(self.T_B_A, self.sightings)
        return float(np.sqrt(np.mean(gap**2))) if len(gap) else 0.0


def align_pairs(sightings: Sightings, looks_alike: I64, options: AnchoringOptions) -> list[Pair]:
    """Align every pair of missions that closures join.

    Args:
        sightings: The accepted closures.
        looks_alike: Closures (M, M) that were refused since places look alike, upper triangle.
        options: When two missions count as aligned.
    """
    joined = np.stack([sightings.mission_A, sightings.mission_B], axis=1)
    doubted = np.argwhere(looks_alike > 0)
    pairs = []
    for a, b in np.unique(np.concatenate([joined, doubted]), axis=0).tolist():
        between = sightings.take((sightings.mission_A == a) & (sightings.mission_B == b))
        count = len(between.weight)
        if count == 0:
            verdict = (
                f"{looks_alike[a, b]} closures with places that look like other places, and none "
                "that tells which of them it is"
            )
            pairs.append(Pair(a, b, np.zeros(4), between, 0, verdict))
            continue
        T_B_A, agree = agreeing(between, options)
        pair = Pair(a, b, T_B_A, between.take(agree), count)
        pairs.append(_judged(_fitted(pair), options))
    return pairs


def _fitted(pair: Pair) -> Pair:
    """Fit the alignment to all closures that agree."""
    good = pair.sightings
    local = dataclasses.replace(
        good, mission_A=np.ones_like(good.mission_A), mission_B=np.zeros_like(good.mission_B)
    )
    start = np.stack([np.zeros(4), pair.T_B_A])
    T_B_A = fit_missions(local, start, np.array([True, False]))[1]
    return dataclasses.replace(pair, T_B_A=T_B_A)


def _judged(pair: Pair, options: AnchoringOptions) -> Pair:
    agreed = len(pair.sightings.weight)
    if agreed < options.min_inlier_count:
        verdict = f"{agreed} closures agree, {options.min_inlier_count} are wanted"
    elif agreed < options.min_inlier_ratio * pair.closures:
        verdict = f"only {agreed} of {pair.closures} closures agree"
    else:
        return pair
    return dataclasses.replace(pair, verdict=verdict)


def consistent(pairs: list[Pair], options: AnchoringOptions, names: list[str]) -> list[Pair]:
    """Refuse pairs that contradict others: going round three missions must lead back.

    Of three alignments that contradict each other, at least one is wrong. Each triangle speaks for
    or against its pairs with the inliers of its weakest one; the pair with most against it (of
    equals the weakest) goes, until nothing contradicts. A pair that has nothing but a contradiction
    to show, and is not clearly stronger than its opponents, goes with them.
    """
    verdicts = {(p.a, p.b): p.verdict for p in pairs}
    used = {(p.a, p.b): p for p in pairs if p.verdict == USED}
    open_, closed = _triangles(used, options)
    while open_:
        balance = dict.fromkeys(used, 0.0)
        for sign, triangles in ((-1.0, open_), (1.0, closed)):
            for triangle in triangles:
                weakest = min(used[edge].weight for edge in triangle)
                for edge in triangle:
                    balance[edge] += sign * weakest
        suspects = {edge for triangle in open_ for edge in triangle}
        worst = min(suspects, key=lambda edge: (balance[edge], used[edge].weight))
        third = next(t for t in open_ if worst in t)
        out = [worst]
        for edge in third:
            is_sure = any(edge in t for t in closed) or used[edge].weight > 2 * used[worst].weight
            if edge != worst and not is_sure:
                out.append(edge)
        a, b, c = sorted({mission for edge in third for mission in edge})
        for edge in out:
            verdicts[edge] = f"contradicts the others among {names[a]}, {names[b]}, {names[c]}"
            del used[edge]
        open_ = [t for t in open_ if all(edge in used for edge in t)]
        closed = [t for t in closed if all(edge in used for edge in t)]
    return [dataclasses.replace(p, verdict=verdicts[p.a, p.b]) for p in pairs]


_Triangle = tuple[tuple[int, int], tuple[int, int], tuple[int, int]]


def _triangles(
    used: dict[tuple[int, int], Pair], options: AnchoringOptions
) -> tuple[list[_Triangle], list[_Triangle]]:
    """Return the triangles of pairs that do not close, and those that do."""
    missions = sorted({mission for edge in used for mission in edge})
    open_: list[_Triangle] = []
    closed: list[_Triangle] = []
    for a, b, c in itertools.combinations(missions, 3):
        triangle = ((a, b), (b, c), (a, c))
        if all(edge in used for edge in triangle):
            ab, bc, ac = (used[edge] for edge in triangle)
            over = yaw.compose(bc.T_B_A, ab.T_B_A)
            (closed if fits(ac, over, options) else open_).append(triangle)
    return open_, closed


def fits(pair: Pair, T_B_A: F64, options: AnchoringOptions) -> bool:
    """Tell whether an alignment that others imply puts the pair's closures where they belong."""
    gap = float(np.median(_gaps(T_B_A, pair.sightings)))
    turn = abs(float(yaw.wrap(T_B_A[3] - pair.T_B_A[3])))
    return (
        gap < _CYCLE_TOLERANCE * options.ransac_max_position_error_m
        and turn < _CYCLE_TOLERANCE * options.ransac_max_orientation_error_rad
    )


def _gaps(T_B_A: F64, sightings: Sightings) -> F64:
    """Return how far apart (N,) [m] the two sides of closures are."""
    gap = yaw.transform(T_B_A, sightings.T_A_I[:, 4:]) - sightings.T_B_I[:, 4:]
    return np.asarray(np.linalg.norm(gap, axis=1))
