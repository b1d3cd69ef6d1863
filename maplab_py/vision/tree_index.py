"""KD-tree over projected descriptors: the exact neighbours in the projected space."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maplab_py.vision.index import DescriptorSet, MatchRule, Neighbours

_FIRST_LOOK, _LAST_LOOK = 8, 512
"""Initial number of candidates per wanted neighbour; increased while the rule leaves too few."""


class TreeIndex:
    """Searches neighbours until k are found that the rule allows."""

    def __init__(self, database: DescriptorSet) -> None:
        """Build the tree."""
        from scipy.spatial import cKDTree

        self._database = database
        self._tree = cKDTree(database.projected)

    def nearest(self, queries: DescriptorSet, k: int, rule: MatchRule) -> Neighbours:
        """Return the nearest database descriptors that the rule allows, one per label."""
        row = np.full((len(queries), k), -1, dtype=np.int32)
        distance = np.full((len(queries), k), np.inf, dtype=np.float32)
        todo, look = np.arange(len(queries)), _FIRST_LOOK * k
        while len(todo) and len(self._database):
            look = min(look, len(self._database))
            part, gap = self._nearest(queries.take(todo), k, look, rule)
            row[todo], distance[todo] = part, gap
            is_last = look == len(self._database) or look >= _LAST_LOOK * k
            todo = todo[:0] if is_last else todo[part[:, -1] < 0]
            look *= 8
        return Neighbours(row, distance)

    def _nearest(
        self, queries: DescriptorSet, k: int, look: int, rule: MatchRule
    ) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        d = self._database
        gap, nearest = self._tree.query(queries.projected, k=np.arange(1, look + 1))
        label = d.label[nearest]
        session = d.session[nearest]
        apart = np.abs(d.time_ns[nearest] - queries.time_ns[:, None]) >= rule.min_time_ns
        other = session != queries.session[:, None]
        allowed = other | (apart & (not rule.other_sessions_only))
        allowed &= (label != queries.label[:, None]) | (label < 0)
        # of each label only the nearest: equal labels stand together after a stable sort
        order = np.argsort(np.where(allowed, label, -2), axis=1, kind="stable")
        sorted_label = np.take_along_axis(np.where(allowed, label, -2), order, axis=1)
        again = np.zeros_like(allowed)
        again[:, 1:] = (sorted_label[:, 1:] == sorted_label[:, :-1]) & (sorted_label[:, 1:] >= 0)
        repeated = np.zeros_like(allowed)
        np.put_along_axis(repeated, order, again, axis=1)
        allowed &= ~repeated
        rank = np.cumsum(allowed, axis=1) - 1
        query, column = np.nonzero(allowed & (rank < k))
        row = np.full((len(queries), k), -1, dtype=np.int32)
        distance = np.full((len(queries), k), np.inf, dtype=np.float32)
        place = rank[query, column]
        row[query, place] = nearest[query, column]
        distance[query, place] = gap[query, column] ** 2
        return row, distance
