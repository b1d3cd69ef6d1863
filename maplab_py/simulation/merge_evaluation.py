"""Evaluate landmark merges: correct, wrong and missing merges."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.array_types import I64
from maplab_py.distinct import distinct
from maplab_py.simulation.truth import Truth
from maplab_py.vimap import VIMap
from maplab_py.vimap.ids import IdIndex
from maplab_py.vimap.table import ragged_rows, starts_of_counts


@dataclasses.dataclass(frozen=True, eq=False)
class Sightings:
    """Observations (O,) of the map whose world point the truth contains."""

    landmark: I64  # row in the map
    point: I64  # world point, -1 = nothing (clutter)
    track: I64  # landmark of the truth that the keypoint belonged to at first, -1 = none


@dataclasses.dataclass(frozen=True)
class MergeCounts:
    """Counts of simulated landmarks (tracks) that were merged or should be."""

    merges: int  # tracks that were joined to another one
    false_merges: int  # of these: joined to tracks of another world point
    missed_merges: int  # landmarks that could still be joined to one of the same world point
    wrong_observations: int  # show another world point than most of their landmark's do


def sightings(vi_map: VIMap, truth: Truth) -> Sightings:
    """Look up the world points of the observations of a map.

    Frames whose number of keypoints has changed are skipped.
    """
    row = IdIndex(truth.frame_id).rows(vi_map.frames.id)
    usable = row >= 0
    usable[usable] = truth.frame_keypoints[row[usable]] == vi_map.frames.keypoint_count[usable]
    start = starts_of_counts(truth.frame_keypoints)
    of_truth = ragged_rows(start, row[usable])
    of_map = ragged_rows(vi_map.keypoint_start, np.flatnonzero(usable))
    landmark = vi_map.keypoints.landmark[of_map].astype(np.int64)
    observing = landmark >= 0
    rows = of_truth[observing]
    return Sightings(landmark[observing], truth.keypoint_point[rows], truth.keypoint_landmark[rows])


def shown_points(seen: Sightings, landmarks: int) -> I64:
    """Return the world point (L,) that most observations of each landmark show, -1 = none.

    Ties are resolved by the lowest row.
    """
    real = seen.point >= 0
    pairs, votes = np.unique(
        np.stack([seen.landmark[real], seen.point[real]], axis=1), axis=0, return_counts=True
    )
    order = np.lexsort((pairs[:, 1], -votes, pairs[:, 0]))
    owner, first = np.unique(pairs[order, 0], return_index=True)
    result = np.full(landmarks, -1, dtype=np.int64)
    result[owner] = pairs[order[first], 1]
    return result


def count_merges(seen: Sightings, truth: Truth, point_of_landmark: I64) -> MergeCounts:
    """Count merges against the truth.

    Args:
        seen: The map's observations.
        truth: The truth.
        point_of_landmark: World point (L,) of the map's landmarks, see `shown_points`.
    """
    known = seen.track >= 0
    pairs = np.unique(np.stack([seen.landmark[known], seen.track[known]], axis=1), axis=0)
    landmark, point_of_track = pairs[:, 0], truth.landmark_point[pairs[:, 1]]
    merges = len(pairs) - len(distinct(landmark))
    # of one landmark's tracks those of the most frequent point are right together
    groups, size = np.unique(
        np.stack([landmark, point_of_track], axis=1), axis=0, return_counts=True
    )
    most = np.zeros(len(point_of_landmark), dtype=np.int64)
    np.maximum.at(most, groups[:, 0], size)
    false_merges = len(pairs) - int(most.sum())
    shown = point_of_landmark[distinct(seen.landmark)]
    shown = shown[shown >= 0]
    wrong = (seen.point >= 0) & (seen.point != point_of_landmark[seen.landmark])
    return MergeCounts(
        merges,
        false_merges,
        len(shown) - len(distinct(shown)),
        int(np.count_nonzero(wrong)),
    )
