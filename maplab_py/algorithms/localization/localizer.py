"""Localise one query at a time: matches, places, pose. Nothing is learned from query to query."""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Iterable, Iterator
from enum import Enum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.localization.database import LocalizationMap
from maplab_py.algorithms.localization.guided import guided_matches
from maplab_py.algorithms.localization.options import LocalizationOptions
from maplab_py.geometry import so3
from maplab_py.vimap.table import ragged_rows
from maplab_py.vision.absolute_pose import LevelProblems, LevelSolutions, search_level
from maplab_py.vision.descriptors import pack_words
from maplab_py.vision.index import DescriptorSet, MatchRule
from maplab_py.vision.multi_index import InvertedMultiIndex

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


_CERTAIN = 2
"""As many times the wanted inliers leave no doubt: no further place is tried."""
_MIN_HYPOTHESIS = 3
"""Inliers that make a pose worth trying on all landmarks in view."""
_GUIDED_ROUNDS = 2
_GUIDED_RADIUS, _GUIDED_DISTANCE = 6.0, 1.3
"""Landmarks in view are looked for in as many times the inliers' error and match distance."""


class Outcome(Enum):
    """What became of a query."""

    LOCALIZED = "localized"
    FEW_MATCHES = "too few matches with one place"
    FEW_INLIERS = "too few inliers"
    TILTED = "gravity deviates"
    UNCERTAIN = "position too uncertain"


@dataclasses.dataclass(frozen=True, eq=False)
class Query:
    """Keypoints of one image, of a rig's images, or of a short sequence, in one body frame."""

    key: int  # with the seed it decides the random numbers
    descriptors: NDArray[np.uint8]  # (N, bytes)
    origin_I: F64  # (N, 3) camera centres in the body frame [m]
    ray_I: F64  # (N, 3) unit rays in the body frame
    rad_per_px: F64  # (N,) angle that a pixel covers
    q_M_I: F64  # (4,) attitude in a gravity-aligned frame; its yaw does not matter


@dataclasses.dataclass(frozen=True, eq=False)
class Localization:
    """Answer to one query; the pose means something only when localised."""

    outcome: Outcome
    T_G_I: F64  # (7,)
    covariance: F64  # (6, 6) of [dp, dtheta], NaN where undetermined
    keypoints: int
    matches: int  # keypoints with a match in the best place
    inliers: int  # landmarks that agree with the pose
    keypoint: I64  # (inliers,) rows of the query
    landmark: I64  # (inliers,) rows of the map
    matching_s: float
    ransac_s: float


class Localizer:
    """A map, indexed."""

    def __init__(self, database: LocalizationMap, options: LocalizationOptions) -> None:
        """Build the index.

        Args:
            database: Where to localise.
            options: Thresholds.
        """
        self._map = database
        self._options = options
        bits = 8 * database.projection.descriptor_size
        self._max_distance = (
            options.max_bit_fraction * bits if database.has_bits else options.max_projected_distance
        )
        self._index = InvertedMultiIndex(
            database.descriptors,
            seed=options.seed,
            cells_per_query=options.num_words_for_nn_search,
            rank_by_bits=database.has_bits,
            max_distance=self._max_distance,
        )

    def localize(self, query: Query) -> Localization:
        """Find the pose of a query in G."""
        begin = time.perf_counter()
        descriptors = self._described(query)
        keypoint, landmark = self._match(descriptors)
        places = self._places(keypoint, landmark)
        first = list(itertools.islice(places, 1))
        matched = time.perf_counter()
        answer = self._solve(query, descriptors, keypoint, landmark, itertools.chain(first, places))
        return dataclasses.replace(
            answer, matching_s=matched - begin, ransac_s=time.perf_counter() - matched
        )

    def _described(self, query: Query) -> DescriptorSet:
        count = len(query.descriptors)
        raw = np.ascontiguousarray(query.descriptors)
        words = self._map.descriptors.words.shape[1]
        return DescriptorSet(
            projected=self._map.projection.project(raw),
            words=pack_words(raw) if words else np.zeros((count, 0), dtype=np.uint64),
            label=np.full(count, -1, dtype=np.int64),
            session=np.full(count, -1, dtype=np.int32),
            time_ns=np.zeros(count, dtype=np.int64),
        )

    def _match(self, descriptors: DescriptorSet) -> tuple[I64, I64]:
        """Return keypoints and landmarks of all matches, sorted by keypoint."""
        found = self._index.nearest(descriptors, self._options.num_neighbors, MatchRule())
        keypoint, rank = np.nonzero((found.row >= 0) & (found.distance <= self._max_distance))
        return keypoint, self._map.descriptors.label[found.row[keypoint, rank]]

    def _places(self, keypoint: I64, landmark: I64) -> Iterator[I64]:
        """Yield the rows of the matches in each of the best places, as far as they are asked for.

        Every matched landmark votes for its observers; the observer with most votes and those
        that share landmarks with it are a place (Sattler et al., ICCV 2015).
        """
        o = self._options
        distinct, index = np.unique(landmark, return_inverse=True)
        offset, observers = self._map.observers_of
        rows = ragged_rows(offset, distinct)
        owner = np.repeat(np.arange(len(distinct)), np.diff(offset)[distinct])
        voter = observers[rows]
        votes = np.bincount(voter, minlength=len(self._map.p_G_observer))
        for _ in range(o.places):
            best = int(np.argmax(votes)) if len(votes) else 0
            if len(distinct) == 0 or votes[best] < 3:
                break
            near = self._map.place_of(best, o.min_shared_landmarks)
            inside = np.bincount(owner, near[voter], minlength=len(distinct)) > 0
            matches = np.flatnonzero(inside[index.reshape(-1)])
            if len(np.unique(keypoint[matches])) >= o.min_matches:
                yield matches
            votes = np.where(near, 0, votes)

    def _solve(
        self,
        query: Query,
        descriptors: DescriptorSet,
        keypoint: I64,
        landmark: I64,
        places: Iterable[I64],
    ) -> Localization:
        """Search the pose place by place; the most inliers win, and many inliers end the search.

        A pose that few matches agree with is tried on all landmarks that it has in view.
        """
        o = self._options
        best = _failed(Outcome.FEW_MATCHES, len(query.descriptors))
        enough = _CERTAIN * o.min_inlier_count
        level = _Level.of(query)
        for number, rows in enumerate(places):
            key = query.key * o.places + number
            found = self._search(level, key, keypoint[rows], landmark[rows])
            for _ in range(_GUIDED_ROUNDS):
                if not _MIN_HYPOTHESIS <= found.landmarks < enough:
                    break
                near = guided_matches(
                    self._map,
                    found.T_G_I,
                    projected=descriptors.projected,
                    words=descriptors.words,
                    origin_I=query.origin_I,
                    ray_I=query.ray_I,
                    radius_rad=_GUIDED_RADIUS * o.ransac_pixel_sigma * query.rad_per_px,
                    max_distance=_GUIDED_DISTANCE * self._max_distance,
                )
                guided = self._search(level, key, *near)
                if guided.landmarks <= found.landmarks:
                    break
                found = guided
            if best.outcome is Outcome.FEW_MATCHES or found.landmarks > best.inliers:
                best = self._judged(query, found)
            if best.outcome is Outcome.LOCALIZED and best.inliers >= enough:
                break
        return best

    def _search(self, level: _Level, key: int, keypoint: I64, landmark: I64) -> _Found:
        """Search the pose from some matches, sorted by keypoint."""
        solutions = search_level(
            LevelProblems(
                start=np.array([0, len(keypoint)]),
                key=np.array([key]),
                origin_W=level.origin_W[keypoint],
                ray_W=level.ray_W[keypoint],
                point_M=self._map.p_G[landmark],
                keypoint=keypoint,
                tolerance=self._options.ransac_pixel_sigma * level.query.rad_per_px[keypoint],
            ),
            seed=self._options.seed,
            max_iterations=self._options.num_ransac_iters,
        )
        agreeing = np.flatnonzero(solutions.is_inlier)
        return _Found(
            level.query, solutions, len(np.unique(keypoint)), keypoint[agreeing], landmark[agreeing]
        )

    def _judged(self, query: Query, found: _Found) -> Localization:
        """Decide whether a pose is to be believed."""
        o = self._options
        solutions, inliers = found.solutions, int(found.solutions.inlier_count[0])
        covariance = solutions.covariances(query.q_M_I[None])[0]
        sigma = float(np.sqrt(np.trace(covariance[:3, :3])))
        if found.landmarks < o.min_inlier_count or inliers < o.min_inlier_ratio * found.matched:
            outcome = Outcome.FEW_INLIERS
        elif np.degrees(solutions.tilt_rad[0]) > o.max_gravity_misalignment_deg:
            outcome = Outcome.TILTED
        elif not sigma <= o.max_position_sigma_m:
            outcome = Outcome.UNCERTAIN
        else:
            outcome = Outcome.LOCALIZED
        return Localization(
            outcome=outcome,
            T_G_I=found.T_G_I,
            covariance=covariance,
            keypoints=len(query.descriptors),
            matches=found.matched,
            inliers=found.landmarks,
            keypoint=found.keypoint,
            landmark=found.landmark,
            matching_s=0.0,
            ransac_s=0.0,
        )


@dataclasses.dataclass(frozen=True, eq=False)
class _Level:
    """A query, turned once to W, the frame of its attitude with the origin at the body."""

    query: Query
    origin_W: F64  # (N, 3)
    ray_W: F64  # (N, 3)

    @classmethod
    def of(cls, query: Query) -> _Level:
        q_W_I = query.q_M_I
        return cls(query, so3.rotate(q_W_I, query.origin_I), so3.rotate(q_W_I, query.ray_I))


@dataclasses.dataclass(frozen=True, eq=False)
class _Found:
    """What a search found, before it is judged."""

    query: Query
    solutions: LevelSolutions
    matched: int  # keypoints with a match
    keypoint: I64  # (inliers,) of the query
    landmark: I64  # (inliers,) of the map

    @cached_property
    def landmarks(self) -> int:
        """How many landmarks agree."""
        return len(np.unique(self.landmark))

    @cached_property
    def T_G_I(self) -> F64:
        """Pose (7,)."""
        return np.asarray(self.solutions.poses(self.query.q_M_I[None])[0])


def _failed(outcome: Outcome, keypoints: int) -> Localization:
    none = np.zeros(0, dtype=np.int64)
    identity = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    unknown = np.full((6, 6), np.nan)
    return Localization(outcome, identity, unknown, keypoints, 0, 0, none, none, 0.0, 0.0)
