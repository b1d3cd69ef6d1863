"""Exhaustive search for the descriptors with the fewest different bits."""

from __future__ import annotations

import numpy as np

from maplab_py.vision.index import DescriptorSet, MatchRule, Neighbours
from maplab_py.vision.search_kernels import search_all


class HammingIndex:
    """Compares every query with every database descriptor: exact, and slow on large maps."""

    def __init__(self, database: DescriptorSet) -> None:
        self._database = database

    def nearest(self, queries: DescriptorSet, k: int, rule: MatchRule) -> Neighbours:
        """Return the nearest database descriptors that the rule allows, one per label."""
        row = np.full((len(queries), k), -1, dtype=np.int32)
        distance = np.full((len(queries), k), np.inf, dtype=np.float32)
        d = self._database
        search_all(
            queries.words, queries.label, queries.session, queries.time_ns,
            d.words, d.label, d.session, d.time_ns,
            rule.min_time_ns, rule.other_sessions_only, row, distance,
        )  # fmt: skip
        return Neighbours(row, distance)
