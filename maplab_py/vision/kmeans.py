"""Vocabularies by k-means: seeded, and the same for any thread count."""

import numpy as np

from maplab_py.array_types import F32, I32
from maplab_py.compilation import compiled, prange

MAX_TRAINING_POINTS = 20_000
ITERATIONS = 12


def kmeans(points: F32, count: int, *, seed: int = 0) -> F32:
    """Return `count` centres (count, D) of points (N, D), N >= count; zeros when there are none.

    Starts from distinct random points; a centre that loses all its points stays where it is.
    """
    if len(points) == 0:
        return np.zeros((count, points.shape[1]), dtype=np.float32)
    rng = np.random.default_rng(seed)
    if len(points) > MAX_TRAINING_POINTS:
        points = points[np.sort(rng.choice(len(points), MAX_TRAINING_POINTS, replace=False))]
    centres = points[np.sort(rng.choice(len(points), count, replace=False))].astype(np.float64)
    for _ in range(ITERATIONS):
        word = nearest_centre(points, centres.astype(np.float32))
        size = np.bincount(word, minlength=count)
        sums = np.stack(
            [np.bincount(word, weights=column, minlength=count) for column in points.T], axis=1
        )
        filled = size > 0
        centres[filled] = sums[filled] / size[filled, None]
    return np.ascontiguousarray(centres, dtype=np.float32)


def nearest_centre(points: F32, centres: F32) -> I32:
    """Return the row (N,) of the centre (C, D) that is nearest to each point (N, D)."""
    word = np.empty(len(points), dtype=np.int32)
    _nearest(np.ascontiguousarray(points), centres, word)
    return word


@compiled(parallel=True)
def _nearest(points, centres, word):  # type: ignore[no-untyped-def]
    for i in prange(len(points)):
        best = np.float32(np.inf)
        for c in range(len(centres)):
            total = np.float32(0.0)
            for d in range(points.shape[1]):
                difference = points[i, d] - centres[c, d]
                total += difference * difference
            if total < best:
                best = total
                word[i] = c
