"""Features of a map for place recognition: descriptors, rays and database landmarks."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.algorithms.landmarks.keypoint_rays import keypoint_rays
from maplab_py.algorithms.loop_closure.reports import TrainingReport
from maplab_py.array_types import F64, I32, I64, U8, Mask, mask_of
from maplab_py.distinct import distinct
from maplab_py.errors import EstimationError
from maplab_py.geometry import se3
from maplab_py.memory import require_memory
from maplab_py.vimap import LandmarkQuality, VIMap, to_hex
from maplab_py.vimap.descriptors import (
    DescriptorDepth,
    FeatureType,
    sizes_of_type,
    type_name,
    types_of,
)
from maplab_py.vision.descriptors import DescriptorKind
from maplab_py.vision.index import DescriptorSet
from maplab_py.vision.kmeans import kmeans, nearest_centre
from maplab_py.vision.projection import DIMENSIONS, DescriptorProjection, learn_projection

_BYTES_PER_KEYPOINT = 300
"""Memory per keypoint [bytes] without its descriptor, which is stored twice."""
_RAYS_AT_ONCE = 1 << 18


@dataclasses.dataclass(frozen=True, eq=False)
class MapFeatures:
    """Keypoints with descriptors of one kind, ready to be matched; one row each."""

    keypoint: I64  # (N,) keypoint rows of the map
    vertex: I64  # (N,)
    descriptors: DescriptorSet  # labels are landmark rows
    in_database: Mask  # (N,) observes a landmark of the database
    origin_I: F64  # (N, 3) camera centre in the body frame [m]
    ray_I: F64  # (N, 3) unit rays in the body frame
    rad_per_px: F64  # (N,) angle that a pixel covers there
    kind: DescriptorKind

    def __len__(self) -> int:
        return len(self.keypoint)


def map_features(
    vi_map: VIMap,
    missions: I64,
    *,
    projection: DescriptorProjection | None = None,
    dimensions: int | None = DIMENSIONS,
    feature_type: int = FeatureType.BINARY,
    sizes: tuple[int, ...] = (),
    memory: ProjectionMemory | None = None,
) -> tuple[MapFeatures, DescriptorProjection]:
    """Collect the features of some missions; learn the projection from their tracks unless given.

    A projection for descriptors of another kind is learned again, too.

    Only descriptors of one type and of the most frequent length are used. Features of good landmarks
    that two or more keypoints observe form the database.

    Args:
        projection: Projection of descriptors.
        dimensions: Dimensions of a projection that is learned; None = as many as in summary maps.
        feature_type: Type of the descriptors.
        sizes: Lengths [bytes] that they may have; empty = any.
        memory: Where a projection is kept for the next call.

    Raises:
        EstimationError: There are no such descriptors, all of a mission have another length than
            the most frequent one, or there are too few tracks to learn from.
    """
    frames = vi_map.frames
    wanted = np.isin(vi_map.vertices.mission[frames.vertex], missions) & frames.is_valid
    kind, of_kind = most_frequent_kind(vi_map, wanted, feature_type, sizes)
    size = kind.size
    keypoint = np.flatnonzero(of_kind)
    require_memory(
        float(len(keypoint)) * (_BYTES_PER_KEYPOINT + 2 * size), "reading the descriptors"
    )
    origin, ray, rad_per_px, seen = _rays(vi_map, keypoint)
    seen &= kind.has_content(vi_map.keypoints.descriptor[keypoint, :size])
    if not seen.all():
        keypoint, origin, ray = keypoint[seen], origin[seen], ray[seen]
        rad_per_px = rad_per_px[seen]
    raw = np.ascontiguousarray(vi_map.keypoints.descriptor[keypoint, :size])
    landmark = vi_map.keypoints.landmark[keypoint].astype(np.int64)
    if projection is None or projection.kind != kind:
        memory = memory or ProjectionMemory()
        projection = memory.learned(raw, landmark, kind, dimensions or kind.projected.dimensions)
    vertex = vi_map.keypoint_vertex[keypoint].astype(np.int64)
    descriptors = DescriptorSet(
        projected=projection.project(raw),
        words=kind.comparable(raw),
        label=landmark,
        session=np.ascontiguousarray(vi_map.vertices.mission[vertex]),
        time_ns=np.ascontiguousarray(vi_map.vertices.timestamp_ns[vertex]),
    )
    features = MapFeatures(
        keypoint=keypoint,
        vertex=vertex,
        descriptors=descriptors,
        in_database=np.append(findable_landmarks(vi_map), False)[landmark],
        origin_I=origin,
        ray_I=ray,
        rad_per_px=rad_per_px,
        kind=kind,
    )
    return features, projection


def most_frequent_kind(
    vi_map: VIMap,
    wanted: Mask,
    feature_type: int,
    sizes: tuple[int, ...] = (),
    *,
    flag: str = "--lc_feature_type",
) -> tuple[DescriptorKind, Mask]:
    """Return the most frequent kind of descriptors of a type, and which keypoints (K,) have it.

    Args:
        wanted: Frames (F,) to look at.
        feature_type: Type of the descriptors.
        sizes: Lengths [bytes] that they may have; empty = any.
        flag: What chooses the type, for the message.

    Raises:
        EstimationError: There are none, or all of a mission have another length.
    """
    depths = [DescriptorDepth.UINT8, DescriptorDepth.FLOAT32]
    if feature_type == FeatureType.BINARY:
        depths.pop()
    best: tuple[int, DescriptorKind, I32] | None = None
    for depth in depths:
        of_depth = sizes_of_type(vi_map.frames, feature_type, depth)
        allowed = wanted[vi_map.keypoint_frame]
        if sizes:
            allowed &= np.isin(of_depth, sizes)
        of_depth = np.where(allowed, of_depth, 0)
        by_size = np.bincount(of_depth, minlength=1)
        by_size[0] = 0
        size = int(np.argmax(by_size))
        if size and (best is None or by_size[size] > best[0]):
            best = int(by_size[size]), DescriptorKind(size, feature_type, depth), of_depth
    if best is None:
        raise EstimationError(_no_descriptors(vi_map, feature_type, sizes, flag))
    _, kind, of_depth = best
    _check_missions_match(vi_map, of_depth, kind.size)
    return kind, of_depth == kind.size


def _no_descriptors(vi_map: VIMap, feature_type: int, sizes: tuple[int, ...], flag: str) -> str:
    """Return why a map has no descriptors of a type, and the remedy."""
    name = type_name(feature_type)
    others = sorted(types_of(vi_map.frames) - {feature_type})
    if sizes and feature_type in types_of(vi_map.frames):
        wanted = " or ".join(str(size) for size in sizes)
        return (
            f"the map has no {name} descriptors of {wanted} bytes, as the flag "
            f"{'--feature_type' if flag == '--feature_type' else '--feature_descriptor_type'} asks for"
        )
    if others:
        names = ", ".join(type_name(other) for other in others)
        remedy = f"{flag}={type_name(others[0])} takes those"
        return f"the map has no {name} descriptors, only {names}: {remedy}, extract_features makes others"
    return (
        "the map has no descriptors: places cannot be recognised; extract_features makes some from "
        "images"
    )


def _rays(vi_map: VIMap, keypoint: I64) -> tuple[F64, F64, F64, Mask]:
    """Return `keypoint_rays`, computed in parts, which bounds the memory."""
    count = len(keypoint)
    origin, ray, rad_per_px = np.empty((count, 3)), np.empty((count, 3)), np.empty(count)
    seen = np.empty(count, dtype=np.bool_)
    for begin in range(0, count, _RAYS_AT_ONCE):
        part = slice(begin, begin + _RAYS_AT_ONCE)
        origin[part], ray[part], rad_per_px[part], seen[part] = keypoint_rays(
            vi_map, keypoint[part]
        )
    return origin, ray, rad_per_px, seen


def _check_missions_match(vi_map: VIMap, sizes: I32, size: int) -> None:
    """Check that every mission with descriptors of a type, sizes (K,) [bytes], has some of a size."""
    mission = vi_map.vertices.mission[vi_map.keypoint_vertex]
    count = len(vi_map.missions)
    described = np.bincount(mission[sizes > 0], minlength=count)
    matching = np.bincount(mission[sizes == size], minlength=count)
    others = np.flatnonzero((described > 0) & (matching == 0))
    if not len(others):
        return
    row = int(others[0])
    other = int(sizes[(mission == row) & (sizes > 0)][0])
    raise EstimationError(
        f"mission {to_hex(vi_map.missions.id[row])} has descriptors of {other} bytes, others have "
        f"{size}: they do not match each other (48 is BRISK of C++ maplab, 64 of OpenCV); choose "
        "missions with descriptors of the same size"
    )


def train_projection(
    vi_map: VIMap,
    missions: I64 | None,
    dimensions: int,
    *,
    feature_type: int = FeatureType.BINARY,
    sizes: tuple[int, ...] = (),
) -> tuple[DescriptorProjection, TrainingReport]:
    """Learn a projection from the tracks of some missions (rows; None = all).

    Raises:
        EstimationError: There are no such descriptors, or too few tracks to learn from.
    """
    rows = np.arange(len(vi_map.missions)) if missions is None else missions
    features, projection = map_features(
        vi_map, rows, dimensions=dimensions, feature_type=feature_type, sizes=sizes
    )
    d = features.descriptors
    order = np.argsort(d.label, kind="stable")
    order = order[d.label[order] >= 0]
    label, points = d.label[order], d.projected[order]
    pairs = np.flatnonzero(label[1:] == label[:-1])
    same = np.linalg.norm(points[pairs + 1] - points[pairs], axis=1)
    shuffled = points[np.random.default_rng(0).permutation(len(points))]
    other = np.linalg.norm(shuffled - points, axis=1)
    return projection, TrainingReport(
        descriptors=len(points),
        tracks=len(distinct(label)),
        descriptor_size=projection.descriptor_size,
        dimensions=len(projection.matrix),
        same_distance=float(np.median(same)),
        other_distance=float(np.median(other)),
    )


def findable_landmarks(vi_map: VIMap) -> Mask:
    """Return which landmarks (L,) are in the database: good ones with two or more observations."""
    observed = np.diff(vi_map.observation_start) >= 2
    return np.asarray(observed & (vi_map.landmarks.quality == LandmarkQuality.GOOD))


def points_in_mission(vi_map: VIMap, landmarks: I64, mission: I64) -> F64:
    """Return landmark positions (N, 3) in the frames M of the given missions (N,).

    Landmarks stored in another mission come over the base frames.
    """
    return se3.transform(se3.inverse(vi_map.T_G_M)[mission], vi_map.p_G[landmarks])


# Index of visited stretches by their visual words: which parts of a map look like a new part.
#
# Descriptors are projected to few dimensions and quantised to words; a stretch is the vector of its
# word frequencies, weighted by how rare the words are (Sivic and Zisserman, ICCV 2003). Adding a stretch
# and asking for similar ones takes a time that hardly depends on the size of the map, unlike the search
# of single descriptors, which then only runs over the parts that were retrieved.


_WORDS = 1024
_FEATURES_PER_WORD = 4
_MIN_FEATURES = 400
_TRAINING_FEATURES = 20_000


class PlaceIndex:
    """Stretches in the order in which they were added."""

    def __init__(self) -> None:
        """Start empty; projection and words are learned from the first stretch that suffices."""
        self._projection: DescriptorProjection | None = None
        self._centres = np.zeros((0, 0), dtype=np.float32)
        self._frequencies: list[F64] = []

    def __len__(self) -> int:
        return len(self._frequencies)

    @property
    def is_trained(self) -> bool:
        """Whether the words have been learned."""
        return self._projection is not None

    def train(self, vi_map: VIMap) -> bool:
        """Learn projection and words from the tracks of a map; False where it has too few features.

        Raises:
            EstimationError: There are too few tracks.
        """
        size, keypoints = _features(vi_map, None)
        if len(keypoints) < _MIN_FEATURES:
            return False
        raw = np.ascontiguousarray(vi_map.keypoints.descriptor[keypoints, :size])
        landmark = vi_map.keypoints.landmark[keypoints].astype(np.int64)
        self._projection = learn_projection(raw, landmark)
        step = max(1, len(raw) // _TRAINING_FEATURES)
        words = min(_WORDS, len(raw) // _FEATURES_PER_WORD)
        self._centres = kmeans(self._projection.project(raw[::step]), words)
        return True

    def frequencies(self, vi_map: VIMap, vertices: I64 | None = None) -> F64:
        """Return the word frequencies (W,) of vertices (rows, None = all); zeros without features."""
        if self._projection is None:
            return np.zeros(1)
        size, keypoints = _features(vi_map, vertices)
        if size != self._projection.descriptor_size or not len(keypoints):
            return np.zeros(len(self._centres))
        raw = np.ascontiguousarray(vi_map.keypoints.descriptor[keypoints, :size])
        words = nearest_centre(self._projection.project(raw), self._centres)
        return np.bincount(words, minlength=len(self._centres)) / len(words)

    def add(self, frequencies: F64) -> None:
        """Add a stretch with its word frequencies (W,)."""
        self._frequencies.append(frequencies)

    def similar(self, frequencies: F64, count: int) -> I64:
        """Return up to `count` stretches that are most similar to some frequencies, the best first.

        Similarity is the cosine of the weighted vectors.
        """
        if not self._frequencies or not frequencies.any():
            return np.zeros(0, dtype=np.int64)
        known = np.zeros((len(self._frequencies), len(frequencies)))
        for row, column in enumerate(self._frequencies):
            known[row, : len(column)] = column  # those from before the training have no words
        weight = np.log((1.0 + len(known)) / (1.0 + np.count_nonzero(known, axis=0))) + 1e-3
        a, b = known * weight, frequencies * weight
        norm = np.linalg.norm(a, axis=1) * np.linalg.norm(b)
        score = np.divide(a @ b, norm, out=np.zeros(len(a)), where=norm > 0.0)
        order = np.argsort(-score, kind="stable")[:count]
        return np.asarray(order[score[order] > 0.0], dtype=np.int64)


def _features(vi_map: VIMap, vertices: I64 | None) -> tuple[int, I64]:
    """Return the usual length of binary descriptors and the keypoints of vertices that have it."""
    sizes = vi_map.binary_descriptor_size
    by_size = np.bincount(sizes, minlength=1)
    by_size[0] = 0
    size = int(np.argmax(by_size))
    if vertices is None:
        return size, np.flatnonzero((sizes == size) & (size > 0))
    is_in = mask_of(len(vi_map.vertices), vertices)
    return size, np.flatnonzero((sizes == size) & (size > 0) & is_in[vi_map.keypoint_vertex])


_GROWTH = 2
"""The projection is learned again where there are so many times as many tracked descriptors."""


class ProjectionMemory:
    """The descriptor projection of a growing map.

    A projection is good for descriptors that it was not learned from, and learning it takes longer than
    a search for the places of a few vertices. So it is learned again only for other descriptors, or when
    there is twice as much to learn from as the last time.
    """

    def __init__(self) -> None:
        self._projection: DescriptorProjection | None = None
        self._descriptors = 0

    def learned(
        self, descriptors: U8, track: I64, kind: DescriptorKind, dimensions: int
    ) -> DescriptorProjection:
        """Return the kept projection, or learn one; see `learn_projection`.

        Raises:
            EstimationError: Too few tracks.
        """
        count = int(np.count_nonzero(track >= 0))
        kept = self._projection
        if kept is not None and kept.kind == kind and count <= _GROWTH * self._descriptors:
            wanted = min(dimensions, kind.dimensions)
            if len(kept.matrix) == wanted:
                return kept
        learned = learn_projection(descriptors, track, kind=kind, dimensions=dimensions)
        self._projection, self._descriptors = learned, count
        return learned


@dataclasses.dataclass(frozen=True)
class SearchScope:
    """Limits of a search."""

    # vertices (V,) whose places are looked for, in the whole map; None = all
    queries: Mask | None = None
    # keeps the projection from one search to the next; None = it is learned
    projections: ProjectionMemory | None = None
