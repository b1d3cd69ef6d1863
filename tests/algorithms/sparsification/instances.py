"""Coverage problems of any size: keyframes in a row, landmarks seen from a stretch of it."""

import numpy as np

from maplab_py.algorithms.sparsification.selection import CoverageProblem, level_values


def corridor(
    landmarks: int,
    keyframes: int,
    keep: int,
    *,
    wanted: int = 30,
    levels: int = 2,
    patchiness: float = 0.5,
    weighted: bool = False,
    seed: int = 0,
) -> CoverageProblem:
    """Landmarks along a corridor; `patchiness` is the part of them that sits in few places."""
    rng = np.random.default_rng(seed)
    patches = rng.uniform(0, keyframes, max(keyframes // 40, 1))
    centre = np.where(
        rng.random(landmarks) < patchiness,
        rng.choice(patches, landmarks) + rng.normal(0.0, 3.0, landmarks),
        rng.uniform(0, keyframes, landmarks),
    )
    half = 1.0 + rng.gamma(2.0, 3.0, landmarks)
    first = np.clip(np.ceil(centre - half), 0, keyframes).astype(np.int64)
    last = np.clip(np.floor(centre + half) + 1, first, keyframes).astype(np.int64)
    count = last - first
    landmark = np.repeat(np.arange(landmarks), count)
    step = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    keyframe = first[landmark] + step
    seen = rng.random(len(landmark)) < 0.8
    keyframe, landmark = keyframe[seen], landmark[seen]
    observed = np.bincount(landmark, minlength=landmarks) * rng.uniform(0.3, 1.0, landmarks)
    weight = 1.0 - 0.7 ** np.maximum(np.bincount(landmark, minlength=landmarks), 1)
    weight = weight if weighted else np.ones(landmarks)
    available = np.bincount(keyframe, weight[landmark], minlength=keyframes)
    return CoverageProblem(
        keyframe=keyframe,
        landmark=landmark,
        score=np.clip(observed / np.percentile(observed, 95.0), 0.0, 1.0),
        weight=weight,
        wanted=np.minimum(available, wanted),
        base=np.zeros(keyframes),
        level_value=level_values(levels),
        full=float(wanted),
        keep=keep,
    )
