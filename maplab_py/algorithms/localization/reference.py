"""Reference poses of queries: a ground truth or the query map's trajectory; and frame alignment."""

from __future__ import annotations

import numpy as np

from maplab_py.algorithms.localization.localization import (
    Localizations,
    Reference,
    align_robustly,
)
from maplab_py.array_types import F64, I64
from maplab_py.errors import UserError
from maplab_py.geometry import se3
from maplab_py.geometry.alignment import umeyama
from maplab_py.geometry.interpolation import interpolate_poses
from maplab_py.vimap import VIMap

_MIN_PAIRS = 10


def trajectory_of_queries(
    vi_map: VIMap, localizations: Localizations
) -> tuple[Reference, F64 | None]:
    """Use the poses of the query map; return T_R_G too, None when too few queries were localised.

    If the base frames of the queries' missions are known, both maps are assumed to share G. Else
    the trajectory is first aligned with the localised poses by yaw and position.
    """
    T_G_I = vi_map.T_G_I[localizations.vertex]
    known = np.ones(len(localizations.vertex), dtype=np.bool_)
    missions = np.unique(vi_map.vertices.mission[localizations.vertex])
    if vi_map.baseframes.is_known[vi_map.missions.baseframe[missions]].all():
        return Reference("the query's poses in G", T_G_I, known), se3.identity()
    reference = Reference("the query's trajectory, aligned with the localised poses", T_G_I, known)
    return reference, _from_answers(reference, localizations, level=True)


def ground_truth(
    name: str,
    times_ns: I64,
    T_R_I: F64,
    query: VIMap,
    localizations: Localizations,
    searched: VIMap | None,
) -> tuple[Reference, F64 | None]:
    """Use a ground-truth trajectory; also return T_R_G, None if it cannot be determined.

    A full map is aligned with the ground truth by its vertices, so that errors of the map count.
    A summary map has no times: the localised poses are aligned with the truth robustly.

    Args:
        name: Name of the reference.
        times_ns: Times (N,) of the truth.
        T_R_I: Poses (N, 7) of the truth.
        query: The map of the queries.
        localizations: The localised poses.
        searched: The map that was searched, None for a summary map.

    Raises:
        UserError: No query lies in the truth's time span.
    """
    poses, known = interpolate_poses(
        times_ns, T_R_I, query.vertices.timestamp_ns[localizations.vertex]
    )
    if not known.any():
        raise UserError(f"{name}: none of the queries lies in its time span")
    reference = Reference(name, poses, known)
    if searched is not None:
        where, inside = interpolate_poses(times_ns, T_R_I, searched.vertices.timestamp_ns)
        if inside.sum() >= _MIN_PAIRS:
            T_R_G, _ = umeyama(where[inside, 4:], searched.T_G_I[inside, 4:])
            return reference, T_R_G
    return reference, _from_answers(reference, localizations, level=False)


def _from_answers(reference: Reference, localizations: Localizations, *, level: bool) -> F64 | None:
    both = reference.is_known & localizations.is_localized
    if both.sum() < _MIN_PAIRS:
        return None
    return align_robustly(reference.T_R_I[both, 4:], localizations.T_G_I[both, 4:], level=level)
