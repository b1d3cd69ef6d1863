"""Localise single queries: matches, places, pose. Queries are independent of each other."""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Iterable, Iterator
from enum import Enum
from functools import cached_property

import numpy as np

from maplab_py.algorithms.localization.database import LocalizationMap
from maplab_py.algorithms.localization.guided import guided_matches
from maplab_py.algorithms.localization.options import LocalizationOptions
from maplab_py.array_types import F64, I64, NDArray
from maplab_py.geometry import so3
from maplab_py.vimap.table import ragged_rows
from maplab_py.vision.absolute_pose import LevelProblems, LevelSolutions, mixed_seeds, search_level
from maplab_py.vision.index import DescriptorSet, InvertedMultiIndex, MatchRule

_CERTAIN = 2
"""The search stops at this multiple of the required inliers."""
_MIN_HYPOTHESIS = 3
"""Minimum number of inliers of a pose for guided matching with all visible landmarks."""
_GUIDED_ROUNDS = 2
_GUIDED_RADIUS, _GUIDED_DISTANCE = 6.0, 1.3
"""Search radius and match distance of guided matching, in multiples of those of inliers."""


class Outcome(Enum):
    """Outcome of a query."""

    LOCALIZED = "localized"
    FEW_MATCHES = "too few matches with one place"
    FEW_INLIERS = "too few inliers"
    TILTED = "gravity deviates"
    UNCERTAIN = "position too uncertain"


@dataclasses.dataclass(frozen=True, eq=False)
class Query:
    """Keypoints of one image, of a rig's images, or of a short sequence, in one body frame."""

    key: int  # determines the random numbers, together with the seed
    descriptors: NDArray[np.uint8]  # (N, bytes)
    origin_I: F64  # (N, 3) camera centres in the body frame [m]
    ray_I: F64  # (N, 3) unit rays in the body frame
    rad_per_px: F64  # (N,) angle that a pixel covers
    q_M_I: F64  # (4,) attitude in a gravity-aligned frame; its yaw does not matter


@dataclasses.dataclass(frozen=True, eq=False)
class Localization:
    """Result of one query; the pose is valid only if it was localised."""

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
    """Localises queries in an indexed map."""

    def __init__(self, database: LocalizationMap, options: LocalizationOptions) -> None:
        self._map = database
        self._options = options
        kind = database.projection.kind
        self._max_distance = (
            kind.largest(options.max_bit_fraction, options.max_descriptor_distance)
            if database.has_descriptors
            else kind.largest_projected(
                options.max_projected_distance, len(database.projection.matrix)
            )
        )
        self._index = InvertedMultiIndex(
            database.descriptors,
            seed=options.seed,
            cells_per_query=options.num_words_for_nn_search,
            rank_by_bits=database.has_descriptors,
            max_distance=self._max_distance,
        )

    @property
    def max_distance(self) -> float:
        """Largest difference of descriptors of a match, or squared distance in the projected space."""
        return self._max_distance

    def described(self, descriptors: NDArray[np.uint8]) -> DescriptorSet:
        """Return descriptors (N, bytes) in the form in which the map has them."""
        count = len(descriptors)
        raw = np.ascontiguousarray(descriptors)
        projection, words = self._map.projection, np.zeros((count, 0), dtype=np.uint64)
        return DescriptorSet(
            projected=projection.project(raw),
            words=projection.kind.comparable(raw) if self._map.has_descriptors else words,
            label=np.full(count, -1, dtype=np.int64),
            session=np.full(count, -1, dtype=np.int32),
            time_ns=np.zeros(count, dtype=np.int64),
        )

    def verify(self, query: Query, keypoint: I64, landmark: I64) -> Localization:
        """Find the pose that given matches agree on, sorted by keypoint, without the index."""
        begin = time.perf_counter()
        solution = self._search(
            _Level.of(query), query.key * self._options.places, keypoint, landmark
        )
        answer = self._judge(query, solution)
        return dataclasses.replace(answer, ransac_s=time.perf_counter() - begin)

    def localize(self, query: Query) -> Localization:
        """Find the pose of a query in G."""
        begin = time.perf_counter()
        descriptors = self.described(query.descriptors)
        keypoint, landmark = self._match(descriptors)
        places = self._places(keypoint, landmark)
        first = list(itertools.islice(places, 1))
        matched = time.perf_counter()
        answer = self._solve(query, descriptors, keypoint, landmark, itertools.chain(first, places))
        return dataclasses.replace(
            answer, matching_s=matched - begin, ransac_s=time.perf_counter() - matched
        )

    def _match(self, descriptors: DescriptorSet) -> tuple[I64, I64]:
        """Return keypoints and landmarks of all matches, sorted by keypoint."""
        neighbours = self._index.nearest(descriptors, self._options.num_neighbors, MatchRule())
        keypoint, rank = np.nonzero(
            (neighbours.row >= 0) & (neighbours.distance <= self._max_distance)
        )
        return keypoint, self._map.descriptors.label[neighbours.row[keypoint, rank]]

    def _places(self, keypoint: I64, landmark: I64) -> Iterator[I64]:
        """Yield the rows of the matches in each of the best places, lazily.

        Every matched landmark votes for its observers; the observer with most votes and those
        that share landmarks with it are a place (Sattler 2015).
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
        """Estimate a pose for each place and return the one with most inliers; many inliers end the search.

        A pose with few inliers is refined by guided matching with all visible landmarks.
        """
        o = self._options
        best = _failed(Outcome.FEW_MATCHES, len(query.descriptors))
        enough = _CERTAIN * o.min_inlier_count
        level = _Level.of(query)
        for number, rows in enumerate(places):
            key = query.key * o.places + number
            solution = self._search(level, key, keypoint[rows], landmark[rows])
            for _ in range(_GUIDED_ROUNDS):
                if not _MIN_HYPOTHESIS <= solution.landmarks < enough:
                    break
                near = guided_matches(
                    self._map,
                    solution.T_G_I,
                    projected=descriptors.projected,
                    words=descriptors.words,
                    origin_I=query.origin_I,
                    ray_I=query.ray_I,
                    radius_rad=_GUIDED_RADIUS * o.ransac_pixel_sigma * query.rad_per_px,
                    max_distance=_GUIDED_DISTANCE * self._max_distance,
                )
                guided = self._search(level, key, *near)
                if guided.landmarks <= solution.landmarks:
                    break
                solution = guided
            if best.outcome is Outcome.FEW_MATCHES or solution.landmarks > best.inliers:
                best = self._judge(query, solution)
            if best.outcome is Outcome.LOCALIZED and best.inliers >= enough:
                break
        return best

    def _search(self, level: _Level, key: int, keypoint: I64, landmark: I64) -> _PoseSolution:
        """Estimate the pose from matches, sorted by keypoint."""
        solutions = search_level(
            LevelProblems(
                start=np.array([0, len(keypoint)]),
                seed=mixed_seeds(np.array([key]), self._options.seed),
                origin_W=level.origin_W[keypoint],
                ray_W=level.ray_W[keypoint],
                point_M=self._map.p_G[landmark],
                keypoint=keypoint,
                inverse_sigma=1.0
                / (self._options.ransac_pixel_sigma * level.query.rad_per_px[keypoint]),
            ),
            max_iterations=self._options.num_ransac_iters,
        )
        agreeing = np.flatnonzero(solutions.is_inlier)
        return _PoseSolution(
            level.query, solutions, len(np.unique(keypoint)), keypoint[agreeing], landmark[agreeing]
        )

    def _judge(self, query: Query, solution: _PoseSolution) -> Localization:
        """Decide whether a pose is accepted."""
        o = self._options
        solutions, inliers = solution.solutions, int(solution.solutions.inlier_count[0])
        covariance = solutions.covariances(query.q_M_I[None])[0]
        sigma = float(np.sqrt(np.trace(covariance[:3, :3])))
        if (
            solution.landmarks < o.min_inlier_count
            or inliers < o.min_inlier_ratio * solution.matched
        ):
            outcome = Outcome.FEW_INLIERS
        elif np.degrees(solutions.tilt_rad[0]) > o.max_gravity_misalignment_deg:
            outcome = Outcome.TILTED
        elif not sigma <= o.max_position_sigma_m:
            outcome = Outcome.UNCERTAIN
        else:
            outcome = Outcome.LOCALIZED
        return Localization(
            outcome=outcome,
            T_G_I=solution.T_G_I,
            covariance=covariance,
            keypoints=len(query.descriptors),
            matches=solution.matched,
            inliers=solution.landmarks,
            keypoint=solution.keypoint,
            landmark=solution.landmark,
            matching_s=0.0,
            ransac_s=0.0,
        )


@dataclasses.dataclass(frozen=True, eq=False)
class _Level:
    """A query rotated to W, the frame of its attitude with the origin at the body."""

    query: Query
    origin_W: F64  # (N, 3)
    ray_W: F64  # (N, 3)

    @classmethod
    def of(cls, query: Query) -> _Level:
        q_W_I = query.q_M_I
        return cls(query, so3.rotate(q_W_I, query.origin_I), so3.rotate(q_W_I, query.ray_I))


@dataclasses.dataclass(frozen=True, eq=False)
class _PoseSolution:
    """Result of a pose search before the acceptance test."""

    query: Query
    solutions: LevelSolutions
    matched: int  # keypoints with a match
    keypoint: I64  # (inliers,) of the query
    landmark: I64  # (inliers,) of the map

    @cached_property
    def landmarks(self) -> int:
        """Number of inlier landmarks."""
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
