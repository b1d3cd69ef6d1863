"""Landmark selection as a coverage problem.

Schneider 2019, eq. 4.2, with the score maximised and one slack per keyframe: select exactly n
landmarks with a high sum of scores such that every keyframe observes the wanted number of them.
There are two extensions. Landmarks are weighted by the probability of being matched again. The value
of the coverage of a keyframe decreases in levels, so that ten keyframes which lack one landmark each
are better than one keyframe that lacks ten.
"""

from __future__ import annotations

import dataclasses
from functools import cached_property
from typing import Any

import numpy as np

from maplab_py.array_types import F64, I64, Mask
from maplab_py.vimap.table import starts_of_counts

_TINY = 1e-9


@dataclasses.dataclass(frozen=True, eq=False)
class CoverageProblem:
    """K keyframes, L landmarks, their covisibility, and the wanted coverage."""

    keyframe: (
        I64  # (N,) with `landmark`: pairs of a keyframe and an observed landmark, each pair once
    )
    landmark: I64  # (N,)
    score: F64  # (L,) in [0, 1]
    weight: (
        F64  # (L,) in (0, 1], contribution of a landmark to the cover of keyframes that observe it
    )
    wanted: F64  # (K,) wanted cover of each keyframe, at most the possible cover
    base: F64  # (K,) cover of each keyframe by fixed landmarks
    level_value: F64  # (S,) decreasing value of a unit of cover in S equal parts of `full`
    full: float  # cover at which the last part ends
    keep: int  # landmarks to choose

    @property
    def landmarks(self) -> int:
        """Number of landmarks."""
        return len(self.score)

    @property
    def keyframes(self) -> int:
        """Number of keyframes."""
        return len(self.wanted)

    @cached_property
    def seen(self) -> Any:
        """Sparse matrix (K, L) with ones where a keyframe observes a landmark."""
        from scipy.sparse import csr_array

        ones = np.ones(len(self.landmark))
        shape = (self.keyframes, self.landmarks)
        return csr_array((ones, (self.keyframe, self.landmark)), shape=shape)

    @cached_property
    def seers(self) -> tuple[I64, I64]:
        """Offsets (L + 1) and keyframes, by landmark."""
        order = np.argsort(self.landmark, kind="stable")
        counts = np.bincount(self.landmark, minlength=self.landmarks)
        return starts_of_counts(counts), self.keyframe[order]

    def cover(self, chosen: Mask) -> F64:
        """Return the cover (K,) of the keyframes by a selection (L,)."""
        mine = chosen[self.landmark]
        added = np.bincount(
            self.keyframe[mine], self.weight[self.landmark[mine]], minlength=self.keyframes
        )
        return np.asarray(self.base + added)

    def value(self, cover: F64, wanted: F64) -> F64:
        """Return the values (N,) of covers (N,) of keyframes with wanted cover (N,)."""
        edges = np.linspace(0.0, self.full, len(self.level_value) + 1)
        worth = np.concatenate([[0.0], np.cumsum(self.level_value * np.diff(edges))])
        return np.asarray(np.interp(np.minimum(cover, wanted), edges, worth))

    def objective(self, chosen: Mask) -> float:
        """Return the sum of score and coverage value of a selection (L,)."""
        gained = self.value(self.cover(chosen), self.wanted) - self.value(self.base, self.wanted)
        return float(self.score[chosen].sum() + gained.sum())

    def gain_of_more(self, cover: F64) -> F64:
        """Return the value (K,) of the next unit of cover."""
        return np.where(cover < self.wanted - _TINY, self._value_at(cover + _TINY), 0.0)

    def loss_of_less(self, cover: F64) -> F64:
        """Return the value (K,) of the last unit of cover."""
        return np.where(cover <= self.wanted + _TINY, self._value_at(cover - _TINY), 0.0)

    def _value_at(self, cover: F64) -> F64:
        part = np.floor(cover * len(self.level_value) / max(self.full, _TINY)).astype(np.int64)
        return np.append(self.level_value, 0.0)[np.clip(part, 0, len(self.level_value))]

    def restricted(self, landmarks: I64, chosen: Mask) -> CoverageProblem:
        """Return the subproblem of selecting among some landmarks while the others are fixed.

        Args:
            landmarks: Rows (P,), sorted.
            chosen: The current selection (L,); the subproblem selects the same number of the rows.
        """
        inside = np.zeros(self.landmarks, dtype=np.bool_)
        inside[landmarks] = True
        row = np.cumsum(inside) - 1
        pairs = np.flatnonzero(inside[self.landmark])
        keyframes, keyframe = np.unique(self.keyframe[pairs], return_inverse=True)
        return CoverageProblem(
            keyframe=keyframe.reshape(-1),
            landmark=row[self.landmark[pairs]],
            score=self.score[landmarks],
            weight=self.weight[landmarks],
            wanted=self.wanted[keyframes],
            base=self.cover(chosen & ~inside)[keyframes],
            level_value=self.level_value,
            full=self.full,
            keep=int(chosen[landmarks].sum()),
        )


def level_values(levels: int) -> F64:
    """Return the value (levels,) of cover per level: ..., 4, 2, 1.

    The lowest value is 1, the highest score of a landmark: no score outweighs a landmark that a
    keyframe lacks.
    """
    return np.asarray(2.0 ** np.arange(levels - 1, -1, -1), dtype=np.float64)
