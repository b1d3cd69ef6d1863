"""The alignments of missions that compete, as the report of anchoring lists them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from maplab_py.algorithms.anchoring.reports import AlignmentHypothesis
from maplab_py.algorithms.loop_closure.alignment_contest import Contest, listed_alignments


def described_hypotheses(
    contests: Sequence[Contest], names: Sequence[str]
) -> tuple[AlignmentHypothesis, ...]:
    """Describe the alignments of all pairs of missions that have several or none that wins."""
    return tuple(
        _described(number, contests[i], k, names)
        for number, (i, k) in enumerate(listed_alignments(contests), start=1)
    )


def _described(number: int, contest: Contest, k: int, names: Sequence[str]) -> AlignmentHypothesis:
    alignments = contest.pair.alignments
    alignment = alignments[k]
    only_this = [len(alignment.stretches_A), len(alignment.stretches_B)]
    if len(alignments) > 1:
        rival = alignments[0 if k else 1]
        only_this = [
            len(np.setdiff1d(alignment.stretches(side), rival.stretches(side))) for side in (0, 1)
        ]
    a, b = contest.pair.missions
    x, y, z, yaw_rad = (float(value) for value in alignment.T_B_A)
    return AlignmentHypothesis(
        number=number,
        missions=f"{names[a]} - {names[b]}",
        closures=len(alignment.rows),
        stretches=(len(alignment.stretches_A), len(alignment.stretches_B)),
        only_this=(only_this[0], only_this[1]),
        position_m=(x, y, z),
        yaw_deg=float(np.degrees(yaw_rad)),
        outcome=_outcome(contest, k),
    )


def _outcome(contest: Contest, k: int) -> str:
    if contest.winner < 0:
        return "undecided"
    if k == contest.winner:
        return "wins"
    return "runner-up" if k == (1 if contest.winner == 0 else 0) else "loses"
