"""The missions that a user chooses for a command."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from maplab_py.array_types import I64
from maplab_py.options import Options

if TYPE_CHECKING:
    from maplab_py.vimap import VIMap


class MissionChoice(Options):
    """Missions to work on; all if none is given."""

    map_mission: str = ""
    """Mission id or unambiguous prefix; empty = all missions"""
    map_mission_list: str = ""
    """Several missions, separated by commas"""

    def rows(self, vi_map: VIMap) -> I64 | None:
        """Return the rows of the chosen missions in ascending order, None if none is given (all).

        Raises:
            UserError: An id is unknown or ambiguous; the message lists the candidates.
        """
        from maplab_py.vimap.queries import find_mission

        prefixes = [
            part.strip() for part in f"{self.map_mission},{self.map_mission_list}".split(",")
        ]
        chosen = [prefix for prefix in prefixes if prefix]
        if not chosen:
            return None
        rows = [find_mission(vi_map, prefix) for prefix in chosen]
        return np.array(sorted(set(rows)), dtype=np.int64)


ALL_MISSIONS = MissionChoice()
