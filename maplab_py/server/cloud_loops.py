"""Loops between the clouds of robots' lidars, for joint optimisations."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from maplab_py.algorithms.cloud_registration.options import CloudClosureOptions
from maplab_py.errors import Cancelled, MaplabError
from maplab_py.progress import Progress
from maplab_py.vimap import VIMap


def with_cloud_loops(vi_map: VIMap, map_folder: Path, progress: Progress) -> tuple[VIMap, str]:
    """Add edges between clouds that are near one another; see `close_cloud_loops`.

    Args:
        vi_map: The map.
        map_folder: Folder of the published map, which has the clouds.
        progress: May cancel.

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
