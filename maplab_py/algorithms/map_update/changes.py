"""Regions of a map that vanished, appeared or moved between earlier and later sessions.

A landmark of earlier sessions that later ones should have observed and did not has vanished, or was not
detected; likewise a landmark of later sessions that earlier ones did not observe. A region has changed
where many more landmarks are missing than elsewhere: the probability of a miss is estimated from the rest
of the map.
"""

import dataclasses

import numpy as np

from maplab_py.algorithms.landmarks.evidence import session_times_s
from maplab_py.algorithms.map_update.options import Change, ChangeReport
from maplab_py.algorithms.map_update.visibility import outcome, predict
from maplab_py.array_types import F64, I64, Mask, mask_of
from maplab_py.errors import UserError
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import VIMap, to_hex_list
from maplab_py.vision.descriptors import DescriptorKind, differences

_SIGMA_M, _REACH = 0.25, 3.0
"""Standard deviation of the weight of landmarks around a landmark by their distance, and how many count."""
_LINK_M, _INSIDE_M = 0.8, 0.2
"""Largest gaps in a region, and the distance from it within which matched landmarks speak against it."""
_PLACES, _SESSIONS = np.array([2, 3, 4, 6, 9, 15]), 4
"""Bounds of the numbers of places and of sessions by which the chance of a miss is counted."""
_LEAST_CHANCE = 0.02
_ROUNDS = 2
"""Rounds of counting that chance: each without the landmarks that the one before has for changed."""
_MATCHED_SHARE = 0.8
"""Weight of matched landmarks against missing ones: those of the wall behind an object stay."""
_EVIDENCE_AROUND, _EVIDENCE = 1.5, 10.0
"""Least logarithm of the chance that nothing changed around a landmark, and in a whole region."""
_MIN_MISSING, _MIN_SHARE = 4, 0.7
"""Missing landmarks of a region that is reported, at least, and their share in it."""
MIN_EARLIER, _QUARTER = 2, 0.75
"""Earlier sessions that must have missed a quarter of what counts as new: one misses much by chance."""
_SAME_SHARE = 0.3
"""Share of a region's landmarks that look like those of another, if it has moved there."""
_SAME_BITS = 0.2
"""Share of different bits below which two descriptors look the same."""


@dataclasses.dataclass(frozen=True, eq=False)
class Region:
    """Landmarks (rows) that are missing together."""

    landmarks: I64
    around: int  # landmarks that should have been seen there, these included
    seen_frame: int = -1  # image that sees most of them, and one that should
    missing_frame: int = -1
    seen_s: int = 0  # begin of the session nearest in time that sees them, and that should
    missing_s: int = 0


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
    vanished, missed = missing_regions(vi_map, later, progress)
    appeared, unseen = missing_regions(vi_map, ~later, progress, least_sessions=MIN_EARLIER)
    notes = []
    if np.count_nonzero(~later) < MIN_EARLIER:
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


def seen_by(vi_map: VIMap, missions: Mask) -> Mask:
    """Return which landmarks (L,) missions (M,) observe."""
    keypoints = vi_map.observations
    mine = missions[vi_map.vertices.mission[vi_map.keypoint_vertex[keypoints]]]
    return mask_of(len(vi_map.landmarks), vi_map.keypoints.landmark[keypoints[mine]])


def missing_regions(
    vi_map: VIMap, by: Mask, progress: Progress = SILENT, *, least_sessions: int = 1
) -> tuple[list[Region], Mask]:
    """Return the regions that some missions (M,) miss and others see, and all landmarks that they miss.

    A quarter of a region's landmarks must be missed by so many sessions: in one they are missed together.
    """
    count = len(vi_map.landmarks)
    of, seen = seen_by(vi_map, ~by), seen_by(vi_map, by)
    predicted, matched, sessions = np.zeros((3, count), dtype=np.int64)
    frames, landmarks = [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
    for mission in np.flatnonzero(by).tolist():
        sightings = predict(vi_map, mission, progress)
        mine = of[sightings.landmark]
        session, _ = outcome(vi_map, mission, sightings.take(mine))
        predicted[session.landmark] += session.predicted
        matched[session.landmark] += session.matched
        sessions[session.landmark] += 1
        frames.append(sightings.frame[mine])
        landmarks.append(sightings.landmark[mine])
    is_asked = of & (predicted > 0)
    is_missed = is_asked & (matched == 0) & ~seen
    expected = np.concatenate(frames), np.concatenate(landmarks)
    asked = np.flatnonzero(is_asked)
    regions: list[Region] = []
    for _ in range(_ROUNDS):
        changed = np.zeros(count, dtype=np.bool_)
        changed[np.concatenate([asked[:0], *(region.landmarks for region in regions)])] = True
        missing = is_missed[asked]
        surprise = _surprise(predicted[asked], sessions[asked], missing, changed[asked])
        regions = _regions(vi_map.p_G[asked], asked, is_missed[asked], surprise)
    regions = [r for r in regions if np.quantile(sessions[r.landmarks], _QUARTER) >= least_sessions]
    return [_with_views(vi_map, region, by, expected) for region in regions], is_missed


def _with_views(vi_map: VIMap, region: Region, by: Mask, expected: tuple[I64, I64]) -> Region:
    """Return a region with the images that see most of it and that should.

    Args:
        region: The region.
        by: Missions (M,) that miss it.
        expected: Images and landmarks (N,) that they should see.
    """
    times = session_times_s(vi_map)
    mission_of = vi_map.vertices.mission[vi_map.frames.vertex]
    keypoints = vi_map.observations[
        np.isin(vi_map.keypoints.landmark[vi_map.observations], region.landmarks)
    ]
    seen = vi_map.keypoint_frame[keypoints]
    seen = seen[~by[mission_of[seen]]]
    missing = expected[0][np.isin(expected[1], region.landmarks)]
    seen_s, missing_s = times[mission_of[seen]], times[mission_of[missing]]
    is_earlier = np.median(seen_s) < np.median(missing_s)  # it vanished
    return dataclasses.replace(
        region,
        seen_frame=int(np.argmax(np.bincount(seen))),
        missing_frame=int(np.argmax(np.bincount(missing))),
        seen_s=int(seen_s.max() if is_earlier else seen_s.min()),
        missing_s=int(missing_s.min() if is_earlier else missing_s.max()),
    )


def _surprise(places: I64, sessions: I64, is_missed: Mask, is_changed: Mask) -> F64:
    """Return minus the logarithm of the chance that a landmark is missed although it is there (N,).

    It is the share of missed landmarks among the unchanged ones that as many places and sessions should have
    seen.
    """
    group = _SESSIONS * np.digitize(places, _PLACES) + np.minimum(sessions, _SESSIONS) - 1
    same, groups = group[~is_changed], _SESSIONS * (len(_PLACES) + 1)
    missed = np.bincount(same, is_missed[~is_changed], minlength=groups)
    share = (missed + 1.0) / (np.bincount(same, minlength=groups) + 2.0)
    return np.asarray(-np.log(np.clip(share, _LEAST_CHANCE, 0.9))[group])


def _regions(p_G: F64, asked: I64, is_missed: Mask, surprise: F64) -> list[Region]:
    """Return connected regions of landmarks among those asked for (N,) that are missing together.

    Near landmarks count more: what stands close to a wall hides few of the landmarks behind it.
    """
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    if not is_missed.any():
        return []
    tree = cKDTree(p_G)
    weights = tree.sparse_distance_matrix(tree, _REACH * _SIGMA_M, output_type="coo_matrix").tocsr()
    weights.data = np.exp(-0.5 * np.square(weights.data / _SIGMA_M))
    weights.setdiag(1.0)
    evidence = weights @ np.where(is_missed, surprise, -_MATCHED_SHARE * surprise)
    rows = np.flatnonzero(is_missed & (evidence > _EVIDENCE_AROUND))
    if len(rows) == 0:
        return []
    gaps = cKDTree(p_G[rows])
    linked = gaps.sparse_distance_matrix(gaps, _LINK_M, output_type="coo_matrix")
    groups, label = connected_components(linked, directed=False)
    regions = []
    for group in range(groups):
        inside = rows[label == group]
        close = np.isfinite(cKDTree(p_G[inside]).query(p_G, distance_upper_bound=_INSIDE_M)[0])
        is_large = len(inside) >= _MIN_MISSING and is_missed[close].mean() >= _MIN_SHARE
        if is_large and surprise[inside].sum() >= _EVIDENCE:
            regions.append(Region(asked[inside], int(np.count_nonzero(close))))
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
    frames = np.array([region.seen_frame, region.missing_frame])
    dates = [f"{np.datetime64(t, 's')}"[:10] for t in (region.seen_s, region.missing_s)]
    views = to_hex_list(vi_map.vertices.id[vi_map.frames.vertex[frames]])
    if region.seen_s > region.missing_s:
        dates, views = dates[::-1], views[::-1]
    return Change(
        change=kind,
        x_m=round(float(centre[0]), 2),
        y_m=round(float(centre[1]), 2),
        z_m=round(float(centre[2]), 2),
        size_m=round(float(size.max()), 2),
        missing=len(region.landmarks),
        around=region.around,
        after=dates[0],
        until=dates[1],
        to_m="" if target is None else " ".join(f"{value:.2f}" for value in target),
        view_before=views[0],
        view_after=views[1],
    )
