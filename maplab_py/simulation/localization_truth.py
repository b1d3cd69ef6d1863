"""True poses of localised queries."""

from __future__ import annotations

from pathlib import Path

from maplab_py.algorithms.localization.database import LocalizationMap
from maplab_py.algorithms.localization.localization import Localizations, Reference
from maplab_py.array_types import F64
from maplab_py.errors import UserError
from maplab_py.geometry.alignment import umeyama
from maplab_py.simulation.truth import Truth
from maplab_py.vimap import VIMap
from maplab_py.vimap.ids import IdIndex


def true_poses(
    query: VIMap, localizations: Localizations, database: LocalizationMap, path: Path
) -> tuple[Reference, F64]:
    """Return the true poses of the queries, and T_R_G (7,) from the true poses of the observers.

    Args:
        query: The map of the queries.
        localizations: The localised poses.
        database: What was searched.
        path: The file truth.npz of `simulate`.

    Raises:
        UserError: The file does not know the queries or the observers, or the map has no ids.
    """
    truth = Truth.load(path)
    index = IdIndex(truth.vertex_id)
    row = index.rows(query.vertices.id[localizations.vertex])
    if not (row >= 0).any():
        raise UserError(f"{path} is of another data set: it knows none of the queries")
    reference = Reference(str(path), truth.T_G_I[row], row >= 0)
    if database.observer_id is None:
        raise UserError("the summary map has no ids: its place in the truth is not known")
    observer = index.rows(database.observer_id)
    known = observer >= 0
    if known.sum() < 3:
        raise UserError(f"{path} is of another data set: it knows none of the map's vertices")
    T_R_G, _ = umeyama(truth.T_G_I[observer[known], 4:], database.p_G_observer[known])
    return reference, T_R_G
