"""Estimate alignments of pairs of missions and test them by their closures and by cycles."""

import dataclasses

import numpy as np

from maplab_py.algorithms.anchoring.options import AnchoringOptions
from maplab_py.algorithms.loop_closure.mission_alignment import PairedClosures
from maplab_py.array_types import F64, Mask
from maplab_py.geometry import yaw

USED = "used"
_PAIRS_PER_MISSION = 10
_CYCLE_TOLERANCE = 1.5
"""Tolerance of a cycle in multiples of the tolerance of single closures; drift accumulates."""


@dataclasses.dataclass(frozen=True, eq=False)
class Pair:
    """Alignment of two missions estimated from their closures."""

    a: int
    b: int
    T_B_A: F64  # yaw and position (4,)
    sightings: PairedClosures  # that agree with it
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


def align_pairs(
    sightings: PairedClosures,
    undecided: dict[tuple[int, int], str],
    options: AnchoringOptions,
    wanted: set[tuple[int, int]] | None = None,
) -> list[Pair]:
    """Align pairs of missions that closures join.

    Args:
        sightings: The accepted closures.
        undecided: Pairs whose closures support no unique alignment, with the reason.
        wanted: The pairs to align; None = all.
    """
    rows = sightings.rows_of_pairs()
    pairs = []
    for a, b in sorted({*rows, *undecided}):
        mine = rows.get((a, b), np.zeros(0, dtype=np.int64))
        between = sightings.take(mine)
        if (a, b) in undecided:
            pairs.append(Pair(a, b, np.zeros(4), between, len(mine), undecided[a, b]))
        elif wanted is None or (a, b) in wanted:
            T_B_A, agree = agreeing(between, options)
            pair = Pair(a, b, T_B_A, between.take(agree), len(mine))
            pairs.append(_judge(_fit(pair), options))
    return pairs


def strongest_pairs(sightings: PairedClosures, missions: int) -> set[tuple[int, int]]:
    """Return the strongest pairs of each mission and a maximum spanning forest of all.

    Their number is in proportion to the missions, where that of all pairs grows with the square. In
    a map of few missions they are all pairs.
    """
    rows = sightings.rows_of_pairs()
    ranked = sorted(rows, key=lambda pair: (-float(sightings.weight[rows[pair]].sum()), pair))
    count = np.zeros(missions, dtype=np.int64)
    root = list(range(missions))

    def tree(mission: int) -> int:
        while root[mission] != mission:
            mission = root[mission]
        return mission

    chosen = set()
    for a, b in ranked:
        joins = tree(a) != tree(b)
        if joins or min(count[a], count[b]) < _PAIRS_PER_MISSION:
            root[tree(b)] = tree(a)
            count[[a, b]] += 1
            chosen.add((a, b))
    return chosen


def _fit(pair: Pair) -> Pair:
    """Fit the alignment to all closures that agree."""
    good = pair.sightings
    local = dataclasses.replace(
        good, mission_A=np.ones_like(good.mission_A), mission_B=np.zeros_like(good.mission_B)
    )
    start = np.stack([np.zeros(4), pair.T_B_A])
    T_B_A = fit_missions(local, start, np.array([True, False]))[1]
    return dataclasses.replace(pair, T_B_A=T_B_A)


def _judge(pair: Pair, options: AnchoringOptions) -> Pair:
    agreed = len(pair.sightings.weight)
    if agreed < options.min_inlier_count:
        verdict = f"{agreed} closures agree, {options.min_inlier_count} are needed"
    elif agreed < options.min_inlier_ratio * pair.closures:
        verdict = f"only {agreed} of {pair.closures} closures agree"
    else:
        return pair
    return dataclasses.replace(pair, verdict=verdict)


def consistent(pairs: list[Pair], options: AnchoringOptions, names: list[str]) -> list[Pair]:
    """Reject pairs that contradict others: every cycle of three missions must close.

    Of three alignments that contradict each other, at least one is wrong. Each triangle votes for
    or against its pairs with the number of inliers of its weakest pair. The pair with most votes
    against it (of equals the weakest) is rejected until no contradiction remains. A pair with
    contradictions only is rejected too unless it is clearly stronger than its opponents.
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
    """Return the inconsistent and the consistent triangles of pairs."""
    partners: dict[int, set[int]] = {}
    for a, b in used:  # a < b
        partners.setdefault(a, set()).add(b)
    open_: list[_Triangle] = []
    closed: list[_Triangle] = []
    for a, b in sorted(used):
        for c in sorted(partners[a] & partners.get(b, set())):
            triangle = ((a, b), (b, c), (a, c))
            ab, bc, ac = (used[edge] for edge in triangle)
            over = yaw.compose(bc.T_B_A, ab.T_B_A)
            (closed if fits(ac, over, options) else open_).append(triangle)
    return open_, closed


def fits(pair: Pair, T_B_A: F64, options: AnchoringOptions) -> bool:
    """Return whether the alignment implied by other pairs agrees with the pair's closures."""
    gap = float(np.median(_gaps(T_B_A, pair.sightings)))
    turn = abs(float(yaw.wrap(T_B_A[3] - pair.T_B_A[3])))
    return (
        gap < _CYCLE_TOLERANCE * options.ransac_max_position_error_m
        and turn < _CYCLE_TOLERANCE * options.ransac_max_orientation_error_rad
    )


def _gaps(T_B_A: F64, sightings: PairedClosures) -> F64:
    """Return the distances (N,) [m] between the two ends of closures."""
    gap = yaw.transform(T_B_A, sightings.T_A_I[:, 4:]) - sightings.T_B_I[:, 4:]
    return np.asarray(np.linalg.norm(gap, axis=1))


_SIGMA_M, _SIGMA_RAD = 0.1, 0.02
"""Noise model of a closure, which includes drift inside the missions."""
_MAX_STEPS = 100
_CONVERGED = 1e-10
"""Largest change [m, rad] of a step after which the fit ends."""


def agreeing(sightings: PairedClosures, options: AnchoringOptions) -> tuple[F64, Mask]:
    """Align one pair of missions: the hypothesis of the closure that most inliers support.

    Every closure is a hypothesis (yaw and position), so the result depends on nothing but the
    closures; ties go to the first.

    Returns:
        T_B_A as yaw and position (4,), and which closures agree with it (N,).
    """
    E = sightings.T_B_A
    p = yaw.transform(E[:, None], sightings.T_A_I[None, :, 4:])  # hypothesis, closure
    distance = np.linalg.norm(p - sightings.T_B_I[None, :, 4:], axis=2)
    turn = np.abs(yaw.wrap(E[:, None, 3] - E[None, :, 3]))
    agree = (distance < options.ransac_max_position_error_m) & (
        turn < options.ransac_max_orientation_error_rad
    )
    best = int(np.argmax(agree @ sightings.weight))
    return E[best], np.asarray(agree[best])


def fit_missions(sightings: PairedClosures, start: F64, fixed: Mask) -> F64:
    """Estimate T_G_M (M, 4: position and yaw) of missions by robust least squares over the closures.

    Gauss-Newton with the weights of the loss 2 (sqrt(1 + r^2) - 1) of each whitened residual r.
    The sum of the normal equations takes time in proportion to the closures.

    Args:
        sightings: Closures that agree, of all pairs of missions.
        start: First guess (M, 4) of T_G_M.
        fixed: Missions (M,) whose pose is fixed.
    """
    free = np.flatnonzero(~fixed)
    if len(free) == 0 or len(sightings.weight) == 0:
        return start
    relative_yaw = sightings.T_B_A[:, 3]
    weight = sightings.weight / sightings.weight.mean()
    fitted = start.copy()
    unknown = (4 * free[:, None] + np.arange(4)).ravel()
    for _ in range(_MAX_STEPS):
        residual, J_A, J_B = _residuals(sightings, fitted, relative_yaw)
        robust = weight[:, None] / np.sqrt(1.0 + weight[:, None] * residual**2)
        H, g = _normal_equations(sightings, residual, J_A, J_B, robust, len(start))
        # missions without closures keep their pose
        H[np.diag_indices_from(H)] += np.where(H.diagonal() > 0.0, 0.0, 1.0)
        step = np.zeros(4 * len(start))
        step[unknown] = -np.linalg.solve(H[np.ix_(unknown, unknown)], g[unknown])
        fitted = fitted + step.reshape(-1, 4)
        if np.abs(step).max() < _CONVERGED:
            break
    fitted[:, 3] = yaw.wrap(fitted[:, 3])
    fitted[fixed] = start[fixed]
    return fitted


def _residuals(s: PairedClosures, T_G_M: F64, relative_yaw: F64) -> tuple[F64, F64, F64]:
    """Return whitened residuals (N, 4) and their derivatives (N, 4, 4) by the poses of A and B."""
    A, B = T_G_M[s.mission_A], T_G_M[s.mission_B]
    p_A, p_B = yaw.rotate(A[:, 3], s.T_A_I[:, 4:]), yaw.rotate(B[:, 3], s.T_B_I[:, 4:])
    gap = p_A + A[:, :3] - p_B - B[:, :3]
    turn = yaw.wrap(A[:, 3] - B[:, 3] - relative_yaw)
    residual = np.concatenate([gap / _SIGMA_M, turn[:, None] / _SIGMA_RAD], axis=1)
    derivatives = []
    for p, sign in ((p_A, 1.0), (p_B, -1.0)):
        J = np.zeros((len(gap), 4, 4))
        J[:, :3, :3] = sign * np.eye(3) / _SIGMA_M
        # d (R(yaw) p) / d yaw = z x (R p)
        J[:, 0, 3], J[:, 1, 3] = -sign * p[:, 1] / _SIGMA_M, sign * p[:, 0] / _SIGMA_M
        J[:, 3, 3] = sign / _SIGMA_RAD
        derivatives.append(J)
    return residual, derivatives[0], derivatives[1]


def _normal_equations(
    s: PairedClosures, residual: F64, J_A: F64, J_B: F64, robust: F64, missions: int
) -> tuple[F64, F64]:
    """Return the matrix (4M, 4M) and the gradient (4M,) of all missions."""
    H = np.zeros((missions, missions, 4, 4))
    g = np.zeros((missions, 4))
    for row, J_row in ((s.mission_A, J_A), (s.mission_B, J_B)):
        np.add.at(g, row, np.einsum("nia,ni,ni->na", J_row, robust, residual))
        for column, J_column in ((s.mission_A, J_A), (s.mission_B, J_B)):
            blocks = np.einsum("nia,ni,nib->nab", J_row, robust, J_column)
            np.add.at(H, (row, column), blocks)
    return H.transpose(0, 2, 1, 3).reshape(4 * missions, 4 * missions), g.ravel()
