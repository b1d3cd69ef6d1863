"""Matches guided by verified closures: landmarks of a place near keypoints of its query.

A search for the nearest descriptors of the whole map misses landmarks whose place in the list is taken
by others. A closure predicts where the landmarks of its place are in the images of its query; there a
similar descriptor suffices.
"""

import dataclasses

import numpy as np

from maplab_py.algorithms.landmarks.keypoint_rays import keypoint_rays, landmark_covariance
from maplab_py.algorithms.loop_closure import features
from maplab_py.algorithms.loop_closure.candidates import (
    MIN_SHARED_LANDMARKS,
    is_among,
    sparse_entries,
)
from maplab_py.algorithms.loop_closure.closure_table import Closures
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.array_types import F64, I64, Mask, NDArray, Rows
from maplab_py.geometry import se3, so3, symmetric
from maplab_py.vimap import VIMap, observation_matrix, ragged_rows, starts_of_counts
from maplab_py.vision.descriptors import differences
from maplab_py.vision.rays_and_points import Rays, points_near_rays

_RADIUS_PX = 12.0
_MAX_SIGMAS, _BIT_FACTOR = 2.0, 0.75
"""Limits of matches. Wider ones merge more, but on recorded maps also different points (decision 15)."""
_CLOSURES_AT_ONCE = 256
_NOT_COMPARABLE = np.iinfo(np.int32).max
"""Difference of descriptors of different kinds."""
_DESCRIPTORS = 16
"""Observations of a landmark whose descriptors are compared."""


class LandmarkMatches(Rows):
    """Keypoints of queries matched with landmarks (N,)."""

    closure: I64  # row of `Closures`
    keypoint: I64
    landmark: I64
    bits: NDArray[np.int32]  # different bits, or squared distance of other descriptors


def guided_matches(
    vi_map: VIMap, closures: Closures, usable: Mask, options: LoopClosureOptions
) -> LandmarkMatches:
    """Match keypoints that observe a landmark with another landmark near by.

    Of each query vertex the usable closure with most inliers counts. A match lies within two deviations
    of keypoint, landmark and pose, its descriptors differ in at most three quarters of
    what a match may differ in, and no other keypoint of the image or landmark is more similar.

    Args:
        vi_map: The map, whose landmarks have a quality.
        closures: Closures; their landmark rows are not used.
        usable: Closures (N,) that may be used.
    """
    rows = np.flatnonzero(usable)
    rows = rows[np.lexsort((rows, -closures.inliers[rows], closures.query_vertex[rows]))]
    _, first = np.unique(closures.query_vertex[rows], return_index=True)
    rows = rows[first]
    search = _Search(vi_map, closures, options)
    parts = [
        search.matches(rows[begin : begin + _CLOSURES_AT_ONCE])
        for begin in range(0, len(rows), _CLOSURES_AT_ONCE)
    ]
    empty = np.zeros(0, dtype=np.int64)
    parts.append(LandmarkMatches(empty, empty, empty, empty.astype(np.int32)))
    return LandmarkMatches.concatenate(parts)


class _Search:
    """Data of the map that the searches of all closures use."""

    def __init__(self, vi_map: VIMap, closures: Closures, options: LoopClosureOptions) -> None:
        self._map, self._closures, self._options = vi_map, closures, options
        # the tolerance of an inlier is two deviations of a keypoint
        self._sigma_px = 0.5 * options.ransac_pixel_sigma
        self._sees = observation_matrix(vi_map)
        self._entries = sparse_entries(self._sees)
        self._findable = features.findable_landmarks(vi_map)
        findable = np.flatnonzero(self._findable)
        self._covariance_G = np.zeros((len(vi_map.landmarks), 3, 3))
        self._covariance_G[findable] = landmark_covariance(vi_map, findable, self._sigma_px)
        ends = np.concatenate([closures.query_vertex, closures.place_vertex])
        missions = np.unique(vi_map.vertices.mission[ends])
        wanted = np.isin(vi_map.vertices.mission[vi_map.frames.vertex], missions)
        kind, self._described = features.most_frequent_kind(
            vi_map, wanted, options.type_number, options.sizes
        )
        raw = np.ascontiguousarray(vi_map.keypoints.descriptor[:, : kind.size])
        self._words = kind.comparable(raw)
        self._largest = kind.largest(options.max_bit_fraction, options.max_descriptor_distance)

    def matches(self, rows: I64) -> LandmarkMatches:
        """Return the matches of some closures (rows)."""
        vi_map, c = self._map, self._closures
        problem, landmark = self._landmarks_of_places(rows)
        mission = vi_map.vertices.mission[c.place_vertex[rows]].astype(np.int64)
        p_M = features.points_in_mission(vi_map, landmark, mission[problem])
        p_I = se3.transform(se3.inverse(c.T_M_I[rows])[problem], p_M)
        keypoint, of_keypoint = self._keypoints(c.query_vertex[rows])
        origin_I, ray_I, rad_per_px, seen = keypoint_rays(vi_map, keypoint)
        keypoint, of_keypoint = keypoint[seen], of_keypoint[seen]
        origin_I, ray_I, rad_per_px = origin_I[seen], ray_I[seen], rad_per_px[seen]
        rays = Rays(_starts(of_keypoint, len(rows)), origin_I, ray_I, _RADIUS_PX * rad_per_px)
        ray, near = points_near_rays(rays, _starts(problem, len(rows)), p_I)
        offset = p_I[near] - origin_I[ray]
        depth_m = np.linalg.norm(offset, axis=1)
        sigma_m = self._sigma_px * rad_per_px[ray] * depth_m
        covariance = self._covariance_I(rows, of_keypoint[ray], landmark[near], p_I[near])
        inside = _squared_sigmas(offset, ray_I[ray], covariance, sigma_m)
        inside_rows = np.flatnonzero(inside <= _MAX_SIGMAS**2)
        ray, near = ray[inside_rows], near[inside_rows]
        return self._most_similar(
            LandmarkMatches(
                rows[of_keypoint[ray]], keypoint[ray], landmark[near], np.zeros(len(ray), np.int32)
            )
        )

    def _landmarks_of_places(self, rows: I64) -> tuple[I64, I64]:
        """Return landmarks of the places of closures that their queries do not observe.

        Returns:
            Index into `rows` and landmark (N,), sorted by the first.
        """
        c, sees = self._closures, self._sees
        shared = sees[c.place_vertex[rows]] @ sees.T
        near = (shared >= MIN_SHARED_LANDMARKS).astype(np.int32) @ sees
        problem, landmark = near.tocsr().tocoo().coords
        problem, landmark = problem.astype(np.int64), landmark.astype(np.int64)
        wanted = c.query_vertex[rows][problem] * sees.shape[1] + landmark
        new = self._findable[landmark] & ~is_among(self._entries, wanted)
        problem, landmark = problem[new], landmark[new]
        order = np.lexsort((landmark, problem))
        return problem[order], landmark[order]

    def _keypoints(self, vertices: I64) -> tuple[I64, I64]:
        """Return the keypoints (N,) of vertices that observe a landmark, and the vertices' index."""
        vi_map = self._map
        start = vi_map.keypoint_start[vi_map.frame_start]  # (V + 1,) keypoints of each vertex
        keypoint = ragged_rows(start, vertices)
        owner = np.repeat(np.arange(len(vertices)), np.diff(start)[vertices])
        kept = (vi_map.keypoints.landmark[keypoint] >= 0) & self._described[keypoint]
        return keypoint[kept], owner[kept]

    def _covariance_I(self, rows: I64, problem: I64, landmark: I64, p_I: F64) -> F64:
        """Return the covariances (N, 3, 3) of landmarks in the body frames of closures' queries."""
        c = self._closures
        covariance_G = self._covariance_G[landmark]
        mission = self._map.vertices.mission[c.place_vertex[rows]]
        R_I_M = so3.to_matrix(se3.inverse(c.T_M_I[rows])[:, :4])
        R_I_G = (R_I_M @ so3.to_matrix(se3.inverse(self._map.T_G_M)[mission, :4]))[problem]
        J = np.concatenate([-R_I_M[problem], so3.skew(p_I)], axis=2)  # p_I by [position, angle]
        pose = c.covariance[rows][problem]
        return np.asarray(
            R_I_G @ covariance_G @ R_I_G.transpose(0, 2, 1) + J @ pose @ J.transpose(0, 2, 1)
        )

    def _most_similar(self, near: LandmarkMatches) -> LandmarkMatches:
        """Return the matches that are the most similar ones of their keypoint and of their landmark."""
        vi_map = self._map
        count = np.diff(vi_map.observation_start)[near.landmark]
        compared = np.minimum(count, _DESCRIPTORS)
        owner = np.repeat(np.arange(len(compared)), compared)
        number = np.arange(len(owner)) - np.repeat(np.cumsum(compared) - compared, compared)
        step = number * count[owner] // np.maximum(compared[owner], 1)
        other = vi_map.observations[vi_map.observation_start[near.landmark[owner]] + step]
        bits = differences(self._words, near.keypoint[owner], self._words, other)
        bits[~self._described[other]] = _NOT_COMPARABLE
        fewest = np.full(len(near.keypoint), _NOT_COMPARABLE, dtype=np.int32)
        np.minimum.at(fewest, owner, bits)
        near = dataclasses.replace(near, bits=fewest)
        near = near.take(fewest <= _BIT_FACTOR * self._largest)
        near = near.take(_first(near.bits, near.closure, near.keypoint))
        frame = vi_map.keypoint_frame[near.keypoint].astype(np.int64)
        return near.take(
            _first(near.bits, near.closure, near.landmark * len(vi_map.frames) + frame)
        )


def _first(bits: NDArray[np.int32], closure: I64, key: I64) -> I64:
    """Return the row of the fewest bits of every closure and key, in order."""
    order = np.lexsort((np.arange(len(bits)), bits, key, closure))
    begins = np.ones(len(order), dtype=np.bool_)
    begins[1:] = (np.diff(closure[order]) != 0) | (np.diff(key[order]) != 0)
    return np.sort(order[begins])


def _starts(group: I64, groups: int) -> I64:
    return starts_of_counts(np.bincount(group, minlength=groups))


def _squared_sigmas(offset: F64, ray: F64, covariance: F64, sigma_m: F64) -> F64:
    """Return squared Mahalanobis distances (N,) of points from rays, two degrees of freedom.

    Args:
        offset: From the camera to the point (N, 3).
        ray: Unit rays (N, 3).
        covariance: Of the points (N, 3, 3).
        sigma_m: Standard deviation (N,) of the ray at the point.
    """
    helper = np.eye(3)[np.argmin(np.abs(ray), axis=1)]
    u = np.cross(ray, helper)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    across = np.stack([u, np.cross(ray, u)], axis=1)  # (N, 2, 3)
    error = np.einsum("nij,nj->ni", across, offset)
    S = across @ covariance @ across.transpose(0, 2, 1)
    S += np.square(sigma_m)[:, None, None] * np.eye(2)
    return np.asarray(np.einsum("ni,nij,nj->n", error, symmetric.inverse(S), error))
