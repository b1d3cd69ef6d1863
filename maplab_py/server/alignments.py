"""Loops between the clouds of robots' lidars, for joint optimisations."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from maplab_py.algorithms.anchoring.options import AnchoringReport
from maplab_py.algorithms.anchoring.pairs import USED
from maplab_py.algorithms.cloud_registration.options import CloudClosureOptions
from maplab_py.errors import Cancelled, MaplabError
from maplab_py.progress import Progress
from maplab_py.vimap import VIMap


def with_cloud_loops(vi_map: VIMap, map_folder: Path, progress: Progress) -> tuple[VIMap, str]:
    """Add edges between clouds that are near one another; see `close_cloud_loops`.

    Args:
        map_folder: Folder of the published map, which has the clouds.

    Returns:
        The map, and why no clouds were registered; empty where some were, or there are none.

    Raises:
        Cancelled: The map is as before.
    """
    from maplab_py.algorithms.cloud_registration.scans import CLOUD_TYPES
    from maplab_py.algorithms.cloud_registration.workflow import close_cloud_loops

    if not np.isin(vi_map.resources.type, CLOUD_TYPES).any():
        return vi_map, ""

    try:
        closed, report = close_cloud_loops(
            vi_map, map_folder, CloudClosureOptions(), progress=progress
        )
    except Cancelled:
        raise
    except MaplabError as error:
        return vi_map, f"no clouds were registered: {error}"
    return closed, report.failure


# Pairs of missions that were aligned with each other while neither was anchored.
#
# A submap is compared with those that look most like it, so a mission that is anchored later is not compared
# with all missions that could be anchored through it. The pairs that were aligned before are remembered.


class OpenAlignments:
    """The pairs, with the numbers of the submaps that showed them."""

    def __init__(self) -> None:
        self._pairs: dict[tuple[str, str], frozenset[int]] = {}

    def copy(self) -> OpenAlignments:
        """Return a copy that can be changed."""
        result = OpenAlignments()
        result._pairs = dict(self._pairs)
        return result

    def note(
        self, report: AnchoringReport, names: Mapping[str, str], submaps: Iterable[int]
    ) -> None:
        """Remember the pairs of a report of which neither mission is anchored.

        Args:
            report: What became of missions.
            names: Mission (id) by short name.
            submaps: Numbers of the submaps in which places were looked for.
        """
        numbers = frozenset(submaps)
        for alignment in report.alignments:
            short = alignment.missions.split(" - ")
            if alignment.verdict == USED and all(name in report.not_anchored for name in short):
                pair = (names[short[0]], names[short[1]])
                self._pairs[pair] = self._pairs.get(pair, frozenset()) | numbers

    def take(self, anchored: Iterable[str], most: int) -> dict[str, set[int]]:
        """Take pairs of which one mission is anchored now.

        Args:
            anchored: Missions (ids) that were anchored.
            most: How many of the others are returned at most.

        Returns:
            For each mission that may be anchored, the numbers of the submaps to be searched.
        """
        known, result = set(anchored), dict[str, set[int]]()
        for pair, submaps in list(self._pairs.items()):
            waiting = [mission for mission in pair if mission not in known]
            if len(waiting) == 2:
                continue
            if waiting:
                if waiting[0] not in result and len(result) == most:
                    continue
                result.setdefault(waiting[0], set()).update(submaps)
            del self._pairs[pair]
        return result
