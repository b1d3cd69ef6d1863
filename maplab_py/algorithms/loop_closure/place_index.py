"""Index of visited stretches by their visual words: which parts of a map look like a new part.

Descriptors are projected to few dimensions and quantised to words; a stretch is the vector of its
word frequencies, weighted by how rare the words are (Sivic and Zisserman, ICCV 2003). Adding a stretch
and asking for similar ones takes a time that hardly depends on the size of the map, unlike the search
of single descriptors, which then only runs over the parts that were retrieved.
"""

from __future__ import annotations

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.vimap import VIMap
from maplab_py.vision.kmeans import kmeans, nearest_centre
from maplab_py.vision.projection import DescriptorProjection, learn_projection

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
    is_in = np.zeros(len(vi_map.vertices), dtype=np.bool_)
    is_in[vertices] = True
    return size, np.flatnonzero((sizes == size) & (size > 0) & is_in[vi_map.keypoint_vertex])
