"""Regions of a map that vanished, appeared or moved between earlier and later sessions.

A landmark of the earlier sessions that the later ones should have seen and did not may have vanished, or was
not detected; likewise one of the later sessions that the earlier ones did not see. A region has changed where
many more landmarks are missing than elsewhere.
"""

import dataclasses

import numpy as np

from maplab_py.algorithms.landmarks.evidence import session_times_s
from maplab_py.algorithms.map_update.options import Change, ChangeReport
from maplab_py.algorithms.map_update.visibility import Sightings, outcome, predict
from maplab_py.array_types import F64, I64, Mask
from maplab_py.errors import UserError
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import VIMap
from maplab_py.vision.descriptors import DescriptorKind, differences

_RADIUS_M = 0.5
"""Landmarks within this distance say whether the place of a landmark has changed."""
_MIN_AROUND = 6
"""Landmarks that say it, at least."""
_LIKELY = 2e-3
"""Largest probability of so many missing landmarks around one if nothing has changed."""
_MIN_MISSING = 6
"""Missing landmarks of a region that is reported, at least."""
_MIN_SHARE = 0.8
"""Share of missing landmarks around one from which its place may have changed."""
_MIN_REGION_SHARE = 0.6
"""Share of such landmarks among all in reach of a region, at least."""
_MIN_PLACES = 2
"""Places from which a landmark must have been missed."""
_MIN_EARLIER = 2
"""Earlier sessions that must have missed what counts as new: one misses much by chance."""
_SAME_SHARE = 0.3
"""Share of a region's landmarks that look like those of another, if it has moved there."""
_SAME_BITS = 0.2
"""Share of different bits below which two descriptors look the same."""
_MIN_MISS_RATE = 0.2
"""Rate of missed landmarks where nothing has changed, at least."""


@dataclasses.dataclass(frozen=True, eq=False)
class Region:
    """Landmarks (rows) that are missing together."""

    landmarks: I64
    around: int  # landmarks that should have been seen there, these included


def find_changes(vi_map: VIMap, later: Mask, progress: Progress = SILENT) -> ChangeReport:
    """Return the regions that changed between the earlier and the later missions of a map.

    Args:
        vi_map: The map; all missions are anchored, and landmarks that both saw are merged.
        later: Later missions (M,).

    Raises:
        UserError: There are no earlier or no later missions.
        EstimationError: The map has no descriptors.
    """
    if later.all() or not later.any():
        raise UserError("changes need earlier and later missions: all of them are on one side")
    by_later, by_earlier = _seen_by(vi_map, later), _seen_by(vi_map, ~later)
    vanished, missed = _missing(vi_map, np.flatnonzero(later), by_earlier, by_later, progress)
    appeared, unseen = _missing(vi_map, np.flatnonzero(~later), by_later, by_earlier, progress)
    notes = []
    if np.count_nonzero(~later) < _MIN_EARLIER:
        appeared = []
        notes.append("one earlier session does not tell what appeared since")
    times = session_times_s(vi_map)
    last, first = int(times[~later].max()), int(times[later].min())
    if first < last:
        notes.append(
            "the later session begins before an earlier one: what vanished may have appeared"
        )
    moved = _moves(vi_map, vanished, appeared)
    changes = []
    for number, region in enumerate(vanished):
        target = moved.get(number)
        kind = "vanished" if target is None else "moved"
        to = None if target is None else appeared[target]
        changes.append(_change(vi_map, kind, region, to))
    arrived = set(moved.values())
    changes += [
        _change(vi_map, "appeared", region, None)
        for number, region in enumerate(appeared)
        if number not in arrived
    ]
    return ChangeReport(
        changes=tuple(changes),
        earlier=f"{np.datetime64(last, 's')}",
        later=f"{np.datetime64(first, 's')}",
        landmarks_missed=int(missed.sum()),
        landmarks_new=int(unseen.sum()),
        note="; ".join(notes),
    )


def _seen_by(vi_map: VIMap, missions: Mask) -> Mask:
    """Return which landmarks (L,) missions (M,) observe."""
    keypoints = vi_map.observations
    mine = missions[vi_map.vertices.mission[vi_map.keypoint_vertex[keypoints]]]
    result = np.zeros(len(vi_map.landmarks), dtype=np.bool_)
    result[vi_map.keypoints.landmark[keypoints[mine]]] = True
    return result


def _missing(
    vi_map: VIMap, missions: I64, of: Mask, seen: Mask, progress: Progress
) -> tuple[list[Region], Mask]:
    """Return the regions in which missions (rows) miss landmarks (L,), and all that they miss."""
    count = len(vi_map.landmarks)
    predicted, matched = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.int64)
    for mission in missions.tolist():
        sightings = predict(vi_map, mission, progress)
        mine = of[sightings.landmark]
        columns = (getattr(sightings, f.name)[mine] for f in dataclasses.fields(Sightings))
        session, _ = outcome(vi_map, mission, Sightings(*columns))
        predicted[session.landmark] += session.predicted
        matched[session.landmark] += session.matched
    is_asked = of & (predicted >= _MIN_PLACES)
    is_missed = is_asked & (matched == 0) & ~seen
    return _regions(vi_map.p_G, np.flatnonzero(is_asked), is_missed), is_missed


def _regions(p_G: F64, asked: I64, is_missed: Mask) -> list[Region]:
    """Return connected regions of landmarks among those asked for (N,) that are missing together."""
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree
    from scipy.stats import binom

    if len(asked) == 0:
        return []
    missed = is_missed[asked]
    tree = cKDTree(p_G[asked])
    near = tree.sparse_distance_matrix(tree, _RADIUS_M, output_type="coo_matrix").tocsr()
    near.setdiag(1.0)
    near.data[:] = 1.0
    around = np.asarray(near.sum(axis=1)).reshape(-1)
    missing = np.asarray(near @ missed.astype(np.float64)).reshape(-1)
    rate = max(float(missed.mean()), _MIN_MISS_RATE)
    chance = binom.sf(missing - 1, around, rate)
    changed = missed & (around >= _MIN_AROUND) & (chance < _LIKELY)
    changed &= missing >= _MIN_SHARE * around
    rows = np.flatnonzero(changed)
    groups, label = connected_components(near[rows][:, rows], directed=False)
    regions = []
    for group in range(groups):
        inside = rows[label == group]
        if len(inside) < _MIN_MISSING:
            continue
        close = np.flatnonzero(np.asarray(near[inside].sum(axis=0)).reshape(-1) > 0)
        if len(inside) < _MIN_REGION_SHARE * len(close):
            continue
        regions.append(Region(asked[inside], len(close)))
    return regions


def _moves(vi_map: VIMap, vanished: list[Region], appeared: list[Region]) -> dict[int, int]:
    """Return which vanished regions look like which that appeared, each at most once."""
    sizes = vi_map.binary_descriptor_size
    size = int(sizes.max(initial=0))
    if size == 0:
        return {}
    kind = DescriptorKind(size, 0, 0)
    words = kind.comparable(np.ascontiguousarray(vi_map.keypoints.descriptor[:, :size]))
    limit = 8.0 * size * _SAME_BITS
    first = vi_map.observations[
        np.minimum(vi_map.observation_start[:-1], max(len(vi_map.observations) - 1, 0))
    ]
    scores = []
    for a, old in enumerate(vanished):
        for b, new in enumerate(appeared):
            rows_a = np.repeat(first[old.landmarks], len(new.landmarks))
            rows_b = np.tile(first[new.landmarks], len(old.landmarks))
            bits = differences(words, rows_a, words, rows_b).reshape(len(old.landmarks), -1)
            scores.append((float((bits.min(axis=1) < limit).mean()), a, b))
    moves: dict[int, int] = {}
    for share, a, b in sorted(scores, key=lambda line: (-line[0], line[1], line[2])):
        if share >= _SAME_SHARE and a not in moves and b not in moves.values():
            moves[a] = b
    return moves


def _change(vi_map: VIMap, kind: str, region: Region, to: Region | None) -> Change:
    p_G = vi_map.p_G[region.landmarks]
    centre = np.median(p_G, axis=0)
    size = np.ptp(p_G, axis=0)
    target = None if to is None else np.median(vi_map.p_G[to.landmarks], axis=0)
    return Change(
        change=kind,
        x_m=round(float(centre[0]), 2),
        y_m=round(float(centre[1]), 2),
        z_m=round(float(centre[2]), 2),
        size_m=round(float(size.max()), 2),
        missing=len(region.landmarks),
        around=region.around,
        to_m="" if target is None else " ".join(f"{value:.2f}" for value in target),
    )
