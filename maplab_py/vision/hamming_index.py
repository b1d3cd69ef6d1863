"""Exhaustive search for the descriptors with the fewest different bits."""

from __future__ import annotations

import numpy as np

from maplab_py.vision.index import DescriptorSet, MatchRule, Neighbours
from maplab_py.vision.search_kernels import search_all


class HammingIndex:
    """Compares every query with every database descriptor: exact but slow on large maps."""

    def __init__(self, database: DescriptorSet) -> None:
        """Keep the descriptors."""
        self._database = database

    def nearest(self, queries: DescriptorSet, k: int, rule: MatchRule) -> Neighbours:
        """Return the nearest database descriptors that the rule allows, one per label."""
        row = np.full((len(queries), k), -1, dtype=np.int32)
        distance = np.full((len(queries), k), np.inf, dtype=np.float32)
        search_all(queries.columns, self._database.columns, rule, row, distance)
        return Neighbours(row, distance)
