"""Ids of the recorded closures, as completion offers them; imports little, as a key waits for it."""

from __future__ import annotations

import weakref

from maplab_py.algorithms.loop_closure.closure_record import read_record
from maplab_py.algorithms.loop_closure.closure_table import VERDICTS
from maplab_py.vimap import VIMap
from maplab_py.vimap.ids import to_hex_list

_DESCRIBED: weakref.WeakKeyDictionary[VIMap, list[tuple[str, str]]] = weakref.WeakKeyDictionary()
"""Descriptions of the closures of maps, which do not change as maps are values."""


def described_ids(vi_map: VIMap) -> list[tuple[str, str]]:
    """Return the beginnings of the ids of all recorded closures, with inliers and verdict."""
    if vi_map not in _DESCRIBED:
        c = read_record(vi_map).closures
        _DESCRIBED[vi_map] = [
            (id_[:8], f"{inliers} of {matches} matches, {VERDICTS[verdict].value}")
            for id_, inliers, matches, verdict in zip(
                to_hex_list(c.id),
                c.inliers.tolist(),
                c.matches.tolist(),
                c.verdict.tolist(),
                strict=True,
            )
        ]
    return _DESCRIBED[vi_map]
