"""Visibility of landmarks in a session: predicted and observed.

A landmark is predicted in an image if it projects into it, from a direction and distance near those of its
observers, and the landmarks that the image observes around it are not much nearer. It is matched if the image
observes it, or a similar descriptor is near its projection.
"""

import numpy as np

from maplab_py.algorithms.landmarks.evidence import Session, session_times_s
from maplab_py.algorithms.landmarks.sightings import cameras_of
from maplab_py.algorithms.localization.database import Sights
from maplab_py.algorithms.loop_closure.features import most_frequent_kind
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.array_types import F64, I64, Mask, Rows, mask_of
from maplab_py.distinct import distinct
from maplab_py.geometry import se3, so3
from maplab_py.progress import SILENT, Progress
from maplab_py.sensors.projection import project
from maplab_py.vimap import FeatureType, LandmarkQuality, VIMap, starts_of_counts
from maplab_py.vision.descriptors import differences

_RADIUS_PX = 8.0
_BORDER_PX = 12.0
_TURN_RAD = np.deg2rad(15.0)
"""Tolerance on the direction from which a landmark is expected to be visible."""
_RANGE = 1.3
"""Tolerance on the distance, as a factor."""
_HIDDEN_RATIO = 0.8
"""A landmark is hidden where what is seen around it has less than this share of its depth."""
_AROUND_PX, _AROUND = 60.0, 3
"""Observed landmarks within this distance say what is seen around a landmark: the nearest few."""
_DESCRIPTORS = 12
"""Observations of a landmark whose descriptors are compared."""
_MIN_MATCHED, _MIN_MATCHED_SHARE = 8, 0.3
"""Landmarks that an image must match, in number and as a share, before it counts that others are missing."""
_PLACE_M, _SECTORS = 1.0, 8
"""Images of one place: within a cell of that size, in the same of so many directions."""


class Sightings(Rows):
    """Pairs (N,) of an image and a landmark that should be visible in it."""

    frame: I64
    landmark: I64
    heading_rad: F64  # of the optical axis
    keypoint: I64  # that looks like the landmark, -1 = none
    is_matched: Mask
    is_false: Mask  # a random other landmark would have been matched there, too


def predict(vi_map: VIMap, mission: int, progress: Progress = SILENT) -> Sightings:
    """Predict the landmarks of other missions in the images of a mission, and match them.

    Raises:
        EstimationError: The map has no descriptors.
    """
    search = _Search(vi_map, mission)
    frames = np.flatnonzero(vi_map.vertices.mission[vi_map.frames.vertex] == mission)
    parts = [_nothing()]
    for number, frame in enumerate(frames.tolist()):
        progress.step(number, len(frames), "images")
        parts.append(search.sightings(frame))
    return Sightings.concatenate(parts)


def _nothing() -> Sightings:
    rows, no = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.bool_)
    return Sightings(rows, rows, np.zeros(0), rows, no, no)


def outcome(vi_map: VIMap, mission: int, sightings: Sightings) -> tuple[Session, float]:
    """Return the outcome of a mission by places, and the probability of a false match in it."""
    vertex = vi_map.frames.vertex[sightings.frame]
    sector = np.floor(sightings.heading_rad / (2.0 * np.pi) * _SECTORS)
    cell = np.column_stack([np.floor(vi_map.T_G_I[vertex, 4:] / _PLACE_M), sector])
    _, place = np.unique(cell, axis=0, return_inverse=True)
    count, places = len(vi_map.landmarks), int(place.max(initial=0)) + 1
    key = sightings.landmark * places + place.reshape(-1)

    def places_of(mask: Mask) -> I64:
        return np.bincount(distinct(key[mask]) // places, minlength=count)

    predicted = places_of(np.ones(len(key), dtype=np.bool_))
    matched, false = places_of(sightings.is_matched), places_of(sightings.is_false)
    rows = np.flatnonzero(predicted)
    rate = float(np.count_nonzero(false[rows])) / max(len(rows), 1)
    time_s = int(session_times_s(vi_map)[mission])
    return Session(time_s, rows, predicted[rows], matched[rows]), rate


def main_feature_type(vi_map: VIMap) -> int:
    """Return the type of most descriptors of a map; binary if it has none."""
    types = vi_map.feature_type[vi_map.feature_type >= 0]
    return int(np.argmax(np.bincount(types))) if len(types) else int(FeatureType.BINARY)


class _Search:
    """Data of the map that the searches in all images of a mission use."""

    def __init__(self, vi_map: VIMap, mission: int) -> None:
        options = LoopClosureOptions()
        keypoints = vi_map.observations
        is_other = vi_map.vertices.mission[vi_map.keypoint_vertex[keypoints]] != mission
        others = keypoints[is_other]
        self._map = vi_map
        eyes_G = vi_map.T_G_I[vi_map.keypoint_vertex[others], 4:]
        landmark = vi_map.keypoints.landmark[others].astype(np.int64)
        self._sights = Sights.of(vi_map.p_G, landmark, eyes_G, _TURN_RAD)
        self._is_old = mask_of(len(vi_map.landmarks), vi_map.keypoints.landmark[others])
        self._is_old &= vi_map.landmarks.quality == LandmarkQuality.GOOD
        self._old = np.flatnonzero(self._is_old)
        every = np.ones(len(vi_map.frames), dtype=np.bool_)
        kind, self._described = most_frequent_kind(vi_map, every, main_feature_type(vi_map))
        self._words = kind.comparable(
            np.ascontiguousarray(vi_map.keypoints.descriptor[:, : kind.size])
        )
        self._limit = kind.largest(options.max_bit_fraction, options.max_descriptor_distance)
        others = others[self._described[others]]
        landmark = vi_map.keypoints.landmark[others]
        order = np.lexsort((-others, landmark))  # the newest first
        self._rows = others[order]
        self._start = starts_of_counts(np.bincount(landmark, minlength=len(vi_map.landmarks)))
        self._is_good = vi_map.landmarks.quality == LandmarkQuality.GOOD
        self._random = np.random.default_rng(0).permutation(self._old)  # landmarks for comparison

    def sightings(self, frame: int) -> Sightings:
        """Return the sightings of an image."""
        vi_map = self._map
        start = vi_map.keypoint_start
        keypoints = np.arange(start[frame], start[frame + 1])
        if len(keypoints) == 0 or len(self._old) == 0:
            return _nothing()
        camera, T_I_C, _ = next(iter(cameras_of(vi_map, keypoints[:1])))
        T_G_C = se3.compose(vi_map.T_G_I[vi_map.frames.vertex[frame]], T_I_C)
        rows = self._in_reach(T_G_C[4:])
        p_C = se3.transform(se3.inverse(T_G_C), vi_map.p_G[rows])
        uv, is_visible = project(camera, p_C)
        inside = is_visible & np.all(uv > _BORDER_PX, axis=1)
        inside &= np.all(uv < np.array([camera.width_px, camera.height_px]) - _BORDER_PX, axis=1)
        rows, uv, depth_m = rows[inside], uv[inside], np.linalg.norm(p_C[inside], axis=1)
        if len(rows) == 0:
            return _nothing()
        near = self._near(keypoints, uv)
        similar = self._most_similar(rows, *near)
        is_matched = (similar >= 0) | np.isin(rows, vi_map.keypoints.landmark[keypoints])
        other = self._random[np.searchsorted(self._old, rows)]
        is_false = self._most_similar(other, *near) >= 0
        axis_G = so3.rotate(T_G_C[:4], np.array([0.0, 0.0, 1.0]))
        seen = Sightings(
            frame=np.full(len(rows), frame),
            landmark=rows,
            heading_rad=np.full(len(rows), np.arctan2(axis_G[1], axis_G[0])),
            keypoint=similar,
            is_matched=is_matched,
            is_false=is_false,
        )
        seen = seen.take(is_matched | ~self._is_hidden(keypoints, uv, depth_m, T_G_C[4:]))
        least = max(_MIN_MATCHED, _MIN_MATCHED_SHARE * len(seen))
        if np.count_nonzero(seen.is_matched) >= least:
            return seen
        # the pose is doubtful: what the image does not see may be elsewhere in it
        return seen.take(seen.is_matched)

    def _in_reach(self, eye: F64) -> I64:
        """Return the old landmarks that are seen from a place (3,), as far as direction and distance tell."""
        seen, rows = self._sights, self._old
        toward = eye - self._map.p_G[rows]
        distance = np.linalg.norm(toward, axis=1)
        cosine = np.einsum("ni,ni->n", toward, seen.direction[rows]) / np.maximum(distance, 1e-9)
        reached = distance > seen.nearest_m[rows] / _RANGE
        reached &= distance < seen.farthest_m[rows] * _RANGE
        return np.asarray(rows[reached & (cosine > seen.least_cosine[rows])])

    def _near(self, keypoints: I64, uv: F64) -> tuple[I64, I64]:
        """Return keypoints near pixels (N, 2), as pairs of index and keypoint."""
        mine = keypoints[self._described[keypoints]]
        offset = uv[:, None] - self._map.keypoints.uv_px[mine][None]
        index, column = np.nonzero(np.einsum("nki,nki->nk", offset, offset) < _RADIUS_PX**2)
        return index, mine[column]

    def _most_similar(self, landmarks: I64, index: I64, keypoint: I64) -> I64:
        """Return the keypoint (N,) that looks most like each landmark among its own; -1 = none does."""
        counts = np.minimum(np.diff(self._start)[landmarks], _DESCRIPTORS)[index]
        owner = np.repeat(np.arange(len(index)), counts)
        within = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
        row = self._rows[self._start[landmarks[index[owner]]] + within]
        bits = differences(self._words, keypoint[owner], self._words, row)
        similar = np.flatnonzero(bits <= self._limit)
        order = similar[np.argsort(-bits[similar], kind="stable")]
        result = np.full(len(landmarks), -1, dtype=np.int64)
        result[index[owner[order]]] = keypoint[owner[order]]  # the last one stays
        return result

    def _is_hidden(self, keypoints: I64, uv: F64, depth_m: F64, eye: F64) -> Mask:
        """Return which pixels (N, 2) show something much nearer than a depth (N,)."""
        landmark = self._map.keypoints.landmark[keypoints]
        seen = landmark >= 0
        seen[seen] = self._is_good[landmark[seen]]
        if not seen.any():
            return np.zeros(len(uv), dtype=np.bool_)
        seen_uv = self._map.keypoints.uv_px[keypoints[seen]]
        seen_m = np.linalg.norm(self._map.p_G[landmark[seen]] - eye, axis=1)
        squares = np.sum(np.square(uv[:, None] - seen_uv[None]), axis=2)
        count = min(_AROUND, len(seen_m))
        nearest = np.argpartition(squares, count - 1, axis=1)[:, :count]
        is_near = np.take_along_axis(squares, nearest, axis=1) < _AROUND_PX**2
        is_nearer = seen_m[nearest] < _HIDDEN_RATIO * depth_m[:, None]
        around = is_near.sum(axis=1)
        return np.asarray((around > 0) & (2 * (is_near & is_nearer).sum(axis=1) > around))
