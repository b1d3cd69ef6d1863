"""Choosing landmarks as a coverage problem: what a choice is worth.

Thesis eq. 4.2, its score to be maximised and with one slack per keyframe: choose exactly n
landmarks so that the sum of their scores is high and every keyframe sees the wanted number of
them. Two things are added. A landmark counts by its weight, the chance of being matched again: of
landmarks that were seen once more are needed. And what a keyframe lacks has a price that may rise
with the lack: ten keyframes that lack one landmark each are better than one that lacks ten.
"""

from __future__ import annotations

import dataclasses
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maplab_py.vimap.table import starts_of_counts

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Mask = NDArray[np.bool_]

_TINY = 1e-9


@dataclasses.dataclass(frozen=True, eq=False)
class CoverageProblem:
    """K keyframes, L landmarks, which keyframe sees which, and what is wanted."""

    keyframe: I64  # (N,) with `landmark`: the pairs that see each other, each pair once
    landmark: I64  # (N,)
    score: F64  # (L,) in [0, 1]
    weight: F64  # (L,) in (0, 1], what a landmark adds to the cover of a keyframe that sees it
    wanted: F64  # (K,) cover that each keyframe should have; never more than can be
    base: F64  # (K,) cover that each keyframe has in any case
    price: F64  # (S,) value of a unit of cover in S equal parts of `full`; falling
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
        """Sparse matrix (K, L) of ones where a keyframe sees a landmark."""
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
        """Return the cover (K,) of the keyframes by a choice (L,)."""
        mine = chosen[self.landmark]
        added = np.bincount(
            self.keyframe[mine], self.weight[self.landmark[mine]], minlength=self.keyframes
        )
        return np.asarray(self.base + added)

    def value(self, cover: F64, wanted: F64) -> F64:
        """Return what covers (N,) are worth to keyframes that want so much (N,)."""
        edges = np.linspace(0.0, self.full, len(self.price) + 1)
        worth = np.concatenate([[0.0], np.cumsum(self.price * np.diff(edges))])
        return np.asarray(np.interp(np.minimum(cover, wanted), edges, worth))

    def objective(self, chosen: Mask) -> float:
        """Return score and coverage value of a choice (L,)."""
        gained = self.value(self.cover(chosen), self.wanted) - self.value(self.base, self.wanted)
        return float(self.score[chosen].sum() + gained.sum())

    def price_of_more(self, cover: F64) -> F64:
        """Return the price (K,) of the next bit of cover."""
        return np.where(cover < self.wanted - _TINY, self._price_at(cover + _TINY), 0.0)

    def price_of_less(self, cover: F64) -> F64:
        """Return the price (K,) of the last bit of cover."""
        return np.where(cover <= self.wanted + _TINY, self._price_at(cover - _TINY), 0.0)

    def _price_at(self, cover: F64) -> F64:
        part = np.floor(cover * len(self.price) / max(self.full, _TINY)).astype(np.int64)
        return np.append(self.price, 0.0)[np.clip(part, 0, len(self.price))]

    def restricted(self, landmarks: I64, chosen: Mask) -> CoverageProblem:
        """Return the problem of choosing anew among some landmarks while the others stay.

        Args:
            landmarks: Rows (P,), sorted.
            chosen: The present choice (L,); as many of the rows are to be chosen again.
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
            price=self.price,
            full=self.full,
            keep=int(chosen[landmarks].sum()),
        )


def prices(levels: int) -> F64:
    """Return the price (levels,) of cover, part by part: ..., 4, 2, 1.

    A price of 1 is the highest score a landmark can have: no landmark is worth more for its score
    than one that a keyframe lacks.
    """
    return np.asarray(2.0 ** np.arange(levels - 1, -1, -1), dtype=np.float64)
