"""When T_G_M is set, and when it is set again: never because of a single answer."""

from __future__ import annotations

import collections
import dataclasses
from enum import Enum

import numpy as np

from maplab_py.array_types import F64
from maplab_py.frontend.localization.matcher import Answer
from maplab_py.geometry import se3

_POSITION_M, _YAW_DEG = 0.5, 5.0
"""How near two answers must be to each other to agree; drift of the odometry between them is small."""
_SHARE_OF_TRAVEL = 0.02
"""Drift of the odometry that is allowed between two answers."""
_OLDEST_S = 30.0


class Verdict(Enum):
    """What to do with an answer."""

    WAIT = "wait"  # it does not count yet, or disagrees
    START = "start"  # set T_G_M at this answer
    USE = "use"  # it observes the map that the estimate is in


@dataclasses.dataclass(frozen=True, eq=False)
class _Candidate:
    answer: Answer
    T_M_I: F64
    T_G_M: F64


class AgreementFilter:
    """Collects answers until enough agree, and those that contradict the estimate."""

    def __init__(self, min_num_estimates: int, max_mean_error_px: float) -> None:
        """Begin without answers; see the options."""
        self._least, self._max_mean_error_px = min_num_estimates, max_mean_error_px
        self._candidates: collections.deque[_Candidate] = collections.deque(
            maxlen=min_num_estimates
        )

    def judge(self, answer: Answer, T_M_I: F64, T_G_I: F64 | None, p_G: F64) -> Verdict:
        """Decide about an answer.

        Args:
            answer: Matches of a frame.
            T_M_I: Pose (7,) of the frame in the odometry.
            T_G_I: Its estimated pose (7,) in the map; None = not localised.
            p_G: Landmarks (L, 3) of the map.
        """
        if T_G_I is not None:
            mean_px = float(np.mean(answer.errors_px(T_G_I, p_G)))
            if mean_px <= self._max_mean_error_px:
                self._candidates.clear()
                return Verdict.USE
        if answer.T_G_I is None:
            return Verdict.WAIT
        T_G_M = se3.compose(answer.T_G_I, se3.inverse(T_M_I))
        candidate = _Candidate(answer, T_M_I, T_G_M)
        if self._candidates and not _agree(self._candidates[-1], candidate):
            self._candidates.clear()
        self._candidates.append(candidate)
        return Verdict.START if len(self._candidates) >= self._least else Verdict.WAIT

    def take(self) -> list[Answer]:
        """Return the answers that have agreed, in the order of time, and forget them."""
        answers = [candidate.answer for candidate in self._candidates]
        self._candidates.clear()
        return answers

    def clear(self) -> None:
        """Forget all answers."""
        self._candidates.clear()


def _agree(a: _Candidate, b: _Candidate) -> bool:
    """Tell whether two answers put the body of the later one at the same place."""
    if abs(b.answer.time_ns - a.answer.time_ns) * 1e-9 > _OLDEST_S:
        return False
    step = se3.local(se3.compose(a.T_G_M, b.T_M_I), se3.compose(b.T_G_M, b.T_M_I))
    travelled_m = float(np.linalg.norm(b.T_M_I[4:] - a.T_M_I[4:]))
    near = float(np.linalg.norm(step[:3])) <= _POSITION_M + _SHARE_OF_TRAVEL * travelled_m
    return near and float(np.degrees(np.linalg.norm(step[3:]))) <= _YAW_DEG
