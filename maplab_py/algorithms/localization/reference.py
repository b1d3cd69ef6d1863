"""Where queries really were: a ground truth, or the query's own trajectory; and how frames align."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.localization.localization import (
    Localizations,
    Reference,
    align_robustly,
)
from maplab_py.errors import UserError
from maplab_py.geometry import se3
from maplab_py.geometry.alignment import umeyama
from maplab_py.geometry.interpolation import interpolate_poses
from maplab_py.vimap import VIMap

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

_MIN_PAIRS = 10


def own_trajectory(vi_map: VIMap, found: Localizations) -> tuple[Reference, F64 | None]:
    """Use the query map's own poses; return T_R_G too, None when too few queries were localised.

    Where the base frames of the queries' missions are known, both maps are taken to share G. Else
    the trajectory is first laid on the answers, by yaw and position.
    """
    T_G_I = vi_map.T_G_I[found.vertex]
    known = np.ones(len(found.vertex), dtype=np.bool_)
    missions = np.unique(vi_map.vertices.mission[found.vertex])
    if vi_map.baseframes.is_known[vi_map.missions.baseframe[missions]].all():
        return Reference("the query's poses in G", T_G_I, known), se3.identity()
    reference = Reference("the query's trajectory, laid on the answers", T_G_I, known)
    return reference, _from_answers(reference, found, level=True)


def ground_truth(
    name: str,
    times_ns: I64,
    T_R_I: F64,
    query: VIMap,
    found: Localizations,
    searched: VIMap | None,
) -> tuple[Reference, F64 | None]:
    """Use a ground-truth trajectory; return T_R_G too, None when it cannot be had.

    A full map is laid on the truth by its own vertices, so that its errors count. A summary map
    has no times: the answers themselves are laid on the truth, robustly.

    Args:
        name: What to call it.
        times_ns: Times (N,) of the truth.
        T_R_I: Poses (N, 7) of the truth.
        query: The map of the queries.
        found: The answers.
        searched: The map that was searched, None for a summary map.

    Raises:
        UserError: No query lies in the truth's time span.
    """
    poses, known = interpolate_poses(times_ns, T_R_I, query.vertices.timestamp_ns[found.vertex])
    if not known.any():
        raise UserError(f"{name}: none of the queries lies in its time span")
    reference = Reference(name, poses, known)
    if searched is not None:
        where, inside = interpolate_poses(times_ns, T_R_I, searched.vertices.timestamp_ns)
        if inside.sum() >= _MIN_PAIRS:
            T_R_G, _ = umeyama(where[inside, 4:], searched.T_G_I[inside, 4:])
            return reference, T_R_G
    return reference, _from_answers(reference, found, level=False)


def _from_answers(reference: Reference, found: Localizations, *, level: bool) -> F64 | None:
    both = reference.is_known & found.is_localized
    if both.sum() < _MIN_PAIRS:
        return None
    return align_robustly(reference.T_R_I[both, 4:], found.T_G_I[both, 4:], level=level)
