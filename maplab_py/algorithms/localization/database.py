"""Localisation database: landmarks and descriptors of a full map or a summary map."""

import dataclasses
from functools import cached_property
from typing import Self

import numpy as np

from maplab_py.algorithms.landmarks.quality import evaluate_unknown_quality
from maplab_py.algorithms.loop_closure.features import MapFeatures, map_features
from maplab_py.array_types import F64, I64, U64, NDArray
from maplab_py.distinct import distinct
from maplab_py.errors import EstimationError, UserError
from maplab_py.storage.summary_map import SummaryMap
from maplab_py.vimap import FeatureType, LandmarkQuality, VIMap, table, type_name
from maplab_py.vision.descriptors import DescriptorKind
from maplab_py.vision.index import DescriptorSet
from maplab_py.vision.projection import DescriptorProjection

_TURN_RAD = np.deg2rad(40.0)
"""Tolerance on the view direction from which a landmark is expected to be visible."""


@dataclasses.dataclass(frozen=True, eq=False)
class Sights:
    """View directions and distances from which L landmarks were observed."""

    direction: F64  # (L, 3) unit, in G, toward the middle of the observers
    spread_rad: F64  # (L,) largest angle of an observer from there
    nearest_m: F64  # (L,) distances of the observers
    farthest_m: F64  # (L,)
    turn_rad: float = _TURN_RAD

    @classmethod
    def of(cls, p_G: F64, landmark: I64, eye_G: F64, turn_rad: float = _TURN_RAD) -> Self:
        """Return the sights of landmarks (L, 3); the direction of those without observations is 0.

        Args:
            p_G: Positions.
            landmark: Landmark (N,) of every observation.
            eye_G: Positions (N, 3) of the observers.
            turn_rad: Tolerance on the direction.
        """
        toward, count = eye_G - p_G[landmark], len(p_G)
        distance = np.linalg.norm(toward, axis=1)
        toward /= np.maximum(distance, 1e-9)[:, None]
        sums = [np.bincount(landmark, part, minlength=count) for part in toward.T]
        mean: F64 = np.stack(sums, axis=1)
        mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
        cosine, nearest, farthest = np.ones(count), np.full(count, np.inf), np.zeros(count)
        np.minimum.at(cosine, landmark, np.einsum("ni,ni->n", toward, mean[landmark]))
        np.minimum.at(nearest, landmark, distance)
        np.maximum.at(farthest, landmark, distance)
        spread_rad = np.arccos(np.clip(cosine, -1.0, 1.0))
        return cls(mean, spread_rad, nearest, farthest, turn_rad)

    @cached_property
    def least_cosine(self) -> F64:
        """Cosine (L,) of the largest angle from `direction` from which a landmark may be visible."""
        return np.asarray(np.cos(np.minimum(self.spread_rad + self.turn_rad, np.pi)))


@dataclasses.dataclass(frozen=True, eq=False)
class LocalizationMap:
    """L landmarks observed by K vertices in N observations."""

    p_G: F64  # (L, 3)
    descriptors: DescriptorSet  # (N,) labels are landmark rows; without words in summary maps
    observer: I64  # (N,)
    p_G_observer: F64  # (K, 3)
    observer_id: U64 | None  # (K, 2) ids of the observing vertices
    projection: DescriptorProjection
    landmark: I64 | None = None  # (L,) rows in the map that it was made from

    @property
    def has_descriptors(self) -> bool:
        """Return whether the database holds descriptors, not only projected ones."""
        return bool(self.descriptors.words.shape[1] > 0)

    @cached_property
    def observers_of(self) -> tuple[I64, I64]:
        """Offsets (L + 1) and observers, by landmark."""
        return _group(self.descriptors.label, self.observer, len(self.p_G))

    @cached_property
    def rows_of(self) -> tuple[I64, I64]:
        """Offsets (L + 1) and observation rows, by landmark."""
        label = self.descriptors.label
        counts = np.bincount(label, minlength=len(self.p_G))
        return table.starts_of_counts(counts), np.argsort(label, kind="stable")

    @cached_property
    def sights(self) -> Sights:
        """View directions and distances of each landmark."""
        return Sights.of(self.p_G, self.descriptors.label, self.p_G_observer[self.observer])

    @cached_property
    def landmarks_of(self) -> tuple[I64, I64]:
        """Offsets (K + 1) and landmarks, by observer."""
        return _group(self.observer, self.descriptors.label, len(self.p_G_observer))

    def place_of(self, observer: int, min_shared: int) -> NDArray[np.bool_]:
        """Return which observers (K,) share at least this many landmarks with an observer, or are it."""
        start, landmarks = self.landmarks_of
        mine = landmarks[start[observer] : start[observer + 1]]
        offset, observers = self.observers_of
        seen = observers[table.ragged_rows(offset, mine)]
        near = np.bincount(seen, minlength=len(self.p_G_observer)) >= min_shared
        near[observer] = True
        return np.asarray(near)


def database_of_map(
    vi_map: VIMap,
    *,
    missions: I64 | None = None,
    projection: DescriptorProjection | None = None,
    feature_type: int = FeatureType.BINARY,
    sizes: tuple[int, ...] = (),
) -> LocalizationMap:
    """Build the database from the good landmarks that missions (None = all) observe.

    A single observation suffices: keyframing removes observations but keeps the position that
    they determined.

    Args:
        projection: Projection of the descriptors; None = learned from the tracks.
        feature_type: Type of the descriptors.
        sizes: Lengths [bytes] that they may have; empty = any.

    Raises:
        EstimationError: No landmark has descriptors, or the projection cannot be learned.
    """
    judged, _ = evaluate_unknown_quality(vi_map)
    rows = np.arange(len(judged.missions)) if missions is None else missions
    features, projection = map_features(
        judged, rows, projection=projection, feature_type=feature_type, sizes=sizes
    )
    good_features = features_of_good_landmarks(judged, features)
    if len(good_features) == 0:
        name = type_name(feature_type)
        raise EstimationError(
            f"the map has no good landmark with {name} descriptors: run rtl",
            remedy="retriangulate_landmarks",
        )
    descriptors = features.descriptors.take(good_features)
    landmarks, label = np.unique(descriptors.label, return_inverse=True)
    vertices, observer = np.unique(features.vertex[good_features], return_inverse=True)
    return LocalizationMap(
        p_G=judged.p_G[landmarks],
        descriptors=dataclasses.replace(descriptors, label=label.reshape(-1)),
        observer=observer.reshape(-1),
        p_G_observer=judged.T_G_I[vertices, 4:],
        observer_id=judged.vertices.id[vertices],
        projection=projection,
        landmark=landmarks,
    )


def features_of_good_landmarks(vi_map: VIMap, features: MapFeatures) -> I64:
    """Return the rows of features that observe a landmark of good quality."""
    good = np.append(vi_map.landmarks.quality == LandmarkQuality.GOOD, False)
    return np.flatnonzero(good[features.descriptors.label])


def database_of_summary(summary: SummaryMap) -> LocalizationMap:
    """Build the database from a summary map.

    Raises:
        UserError: It holds no projection, or it is empty.
    """
    if summary.projection is None:
        raise UserError(
            "the summary map does not hold the projection of its descriptors: it was written "
            "by another program"
        )
    described = summary.descriptor_kind
    kind = None if described is None else DescriptorKind(*described)  # None = binary
    count = len(summary.descriptors)
    if count == 0:
        raise UserError("the summary map has no landmark")
    order = np.argsort(summary.landmark, kind="stable")
    descriptors = DescriptorSet(
        projected=np.ascontiguousarray(summary.descriptors[order]),
        words=np.zeros((count, 0), dtype=np.uint64),
        label=summary.landmark[order].astype(np.int64),
        session=np.zeros(count, dtype=np.int32),
        time_ns=np.zeros(count, dtype=np.int64),
    )
    return LocalizationMap(
        p_G=summary.p_G.astype(np.float64),
        descriptors=descriptors,
        observer=summary.observer[order].astype(np.int64),
        p_G_observer=summary.p_G_observer.astype(np.float64),
        observer_id=summary.observer_id,
        projection=DescriptorProjection(summary.projection, kind),
    )


def _group(key: I64, value: I64, groups: int) -> tuple[I64, I64]:
    """Return offsets (groups + 1) and distinct values, by key."""
    size = int(value.max(initial=0)) + 1
    pairs = distinct(key * size + value)
    counts = np.bincount(pairs // size, minlength=groups)
    return table.starts_of_counts(counts), pairs % size
