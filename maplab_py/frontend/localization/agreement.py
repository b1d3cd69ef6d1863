"""Decision to set T_G_M, and to set it again: never because of a single answer.

Where the map looks like another place, wrong answers agree with each other for a while. A localised odometry
knows where it is but for its drift since it last observed the map; answers that contradict it by more are
believed only when they agree for longer, or have many matches.
"""

import collections
import dataclasses
from enum import Enum

import numpy as np

from maplab_py.array_types import F64
from maplab_py.frontend.localization.matcher import Answer
from maplab_py.geometry import se3

_POSITION_M, _YAW_DEG = 0.5, 5.0
"""Largest difference of two answers that agree; drift of the odometry between them is small."""
_SHARE_OF_TRAVEL = 0.02
"""Drift of the odometry that is allowed between two answers."""
_OLDEST_S = 30.0
_LARGEST_DRIFT, _LARGEST_TURN_DEG = 0.05, 10.0
"""Possible drift since the map was last observed, as a share of the path, and possible turn."""
_IMPOSSIBLE = 4
"""So many times as many answers must agree that the estimate is off by more than it can have drifted."""
_ENOUGH_MATCHES = 80
"""Matches of answers that agree, from which on their number does not matter.

Where the map looks like another place, wrong answers have five to eleven matches (Tango): eight of them. In a
map that was moved, an answer has dozens.
"""


class Verdict(Enum):
    """Use of an answer."""

    WAIT = "wait"  # it does not count yet, or disagrees
    START = "start"  # set T_G_M at this answer
    USE = "use"  # it observes the map that the estimate is in


@dataclasses.dataclass(frozen=True, eq=False)
class _Candidate:
    answer: Answer
    T_M_I: F64
    T_G_M: F64
    is_possible: bool  # as far as the odometry drifts


class AgreementFilter:
    """Collects answers until enough agree, and those that contradict the estimate."""

    def __init__(self, min_num_estimates: int, max_mean_error_px: float) -> None:
        """Begin without answers; see the options."""
        self._least, self._max_mean_error_px = min_num_estimates, max_mean_error_px
        self._candidates: collections.deque[_Candidate] = collections.deque(
            maxlen=_IMPOSSIBLE * min_num_estimates
        )
        self._observed_at_m = 0.0  # where on the path the map was last observed

    def judge(
        self, answer: Answer, T_M_I: F64, T_G_I: F64 | None, p_G: F64, *, path_m: float
    ) -> Verdict:
        """Decide about an answer.

        Args:
            answer: Matches of a frame.
            T_M_I: Pose (7,) of the frame in the odometry.
            T_G_I: Its estimated pose (7,) in the map; None = not localised.
            p_G: Landmarks (L, 3) of the map.
            path_m: Length of the odometry's path up to the frame.
        """
        if T_G_I is not None:
            mean_px = float(np.mean(answer.errors_px(T_G_I, p_G)))
            if mean_px <= self._max_mean_error_px:
                self._candidates.clear()
                self._observed_at_m = path_m
                return Verdict.USE
        if answer.T_G_I is None:
            return Verdict.WAIT
        T_G_M = se3.compose(answer.T_G_I, se3.inverse(T_M_I))
        is_possible = T_G_I is None or self._may_drift(T_G_I, answer.T_G_I, path_m)
        candidate = _Candidate(answer, T_M_I, T_G_M, is_possible)
        if self._candidates and not _agree(self._candidates[-1], candidate):
            self._candidates.clear()
        self._candidates.append(candidate)
        if len(self._candidates) < self._required():
            return Verdict.WAIT
        self._observed_at_m = path_m
        return Verdict.START

    def _required(self) -> int:
        """Return how many answers must agree: more if the odometry cannot have drifted to some."""
        matches = sum(len(candidate.answer) for candidate in self._candidates)
        if all(c.is_possible for c in self._candidates) or matches >= _ENOUGH_MATCHES:
            return self._least
        return _IMPOSSIBLE * self._least

    def _may_drift(self, T_G_I: F64, answered: F64, path_m: float) -> bool:
        """Tell whether the odometry can have drifted from an answer to the estimate, both (7,)."""
        step = se3.local(T_G_I, answered)
        most_m = _POSITION_M + _LARGEST_DRIFT * (path_m - self._observed_at_m)
        near = float(np.linalg.norm(step[:3])) <= most_m
        return near and float(np.degrees(np.linalg.norm(step[3:]))) <= _LARGEST_TURN_DEG

    def take(self) -> list[Answer]:
        """Return the answers that have agreed, in the order of time, and forget them."""
        answers = [candidate.answer for candidate in self._candidates]
        self._candidates.clear()
        return answers

    def clear(self) -> None:
        """Forget all answers; the path begins again."""
        self._candidates.clear()
        self._observed_at_m = 0.0


def _agree(a: _Candidate, b: _Candidate) -> bool:
    """Tell whether two answers put the body of the later one at the same place."""
    if abs(b.answer.time_ns - a.answer.time_ns) * 1e-9 > _OLDEST_S:
        return False
    step = se3.local(se3.compose(a.T_G_M, b.T_M_I), se3.compose(b.T_G_M, b.T_M_I))
    travelled_m = float(np.linalg.norm(b.T_M_I[4:] - a.T_M_I[4:]))
    near = float(np.linalg.norm(step[:3])) <= _POSITION_M + _SHARE_OF_TRAVEL * travelled_m
    return near and float(np.degrees(np.linalg.norm(step[3:]))) <= _YAW_DEG
