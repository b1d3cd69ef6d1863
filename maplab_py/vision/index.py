"""Nearest descriptors of a database: the protocol of an index and its data."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

from maplab_py.array_types import F32, I8, I32, I64, U64


class DescriptorColumns(NamedTuple):
    """Descriptors as the compiled searches take them, see `DescriptorSet`."""

    words: U64 | I8  # (N, W)
    label: I64  # (N,)
    session: I32  # (N,)
    time_ns: I64  # (N,)


@dataclasses.dataclass(frozen=True, eq=False)
class DescriptorSet:
    """Descriptors with the labels, sessions and times that restrict matches."""

    projected: F32  # (N, dimensions)
    words: U64 | I8  # (N, W), packed bits, or signed bytes of descriptors that are not binary
    label: I64  # (N,) landmark; a match of equal non-negative labels is not reported
    session: I32  # (N,) mission
    time_ns: I64  # (N,)

    def __len__(self) -> int:
        return len(self.label)

    @property
    def columns(self) -> DescriptorColumns:
        """Bits, and what restricts matches."""
        return DescriptorColumns(self.words, self.label, self.session, self.time_ns)

    def take(self, rows: I64) -> DescriptorSet:
        """Return the descriptors of the given rows."""
        return DescriptorSet(
            self.projected[rows],
            self.words[rows],
            self.label[rows],
            self.session[rows],
            self.time_ns[rows],
        )


class MatchRule(NamedTuple):
    """Restriction of the database descriptors that a query may match."""

    min_time_ns: int = 0  # within a session, matches closer in time are left out
    other_sessions_only: bool = False


@dataclasses.dataclass(frozen=True, eq=False)
class Neighbours:
    """The k nearest neighbours of every query in ascending order, one per label."""

    row: I32  # (Q, k), -1 where there are fewer than k
    distance: F32  # (Q, k) as `differences`, or squared in the projected space; inf where none
