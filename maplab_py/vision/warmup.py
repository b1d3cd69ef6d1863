"""Compile the kernels of place recognition by running each once on tiny data."""

from __future__ import annotations

import numpy as np

from maplab_py.geometry import se3, so3
from maplab_py.vision.absolute_pose import HYPOTHESES, PoseProblems, solve_poses
from maplab_py.vision.descriptors import hamming, pack_words
from maplab_py.vision.index import INDEX_ENGINES, DescriptorSet, MatchRule, make_index
from maplab_py.vision.point_covariance import covariance_by_rays, squared_sigmas
from maplab_py.vision.projection import learn_projection
from maplab_py.vision.track_union import unite_tracks


def compile_search() -> None:
    """Compile projection, indices, Hamming distances, and what merging landmarks needs."""
    tracks, length = 60, 5
    rng = np.random.default_rng(0)
    label = np.repeat(np.arange(tracks), length)
    descriptors = rng.integers(0, 256, (tracks, 8), dtype=np.uint8)[label]
    words = pack_words(descriptors)
    database = DescriptorSet(
        projected=learn_projection(descriptors, label, dimensions=4).project(descriptors),
        words=words,
        label=label,
        session=np.zeros(len(label), dtype=np.int32),
        time_ns=np.zeros(len(label), dtype=np.int64),
    )
    for engine in INDEX_ENGINES:
        make_index(engine, database, seed=0, words_per_query=4).nearest(database, 2, MatchRule())
    hamming(words, label, words, label)
    rows = np.arange(3)
    unite_tracks(rows[1:2], rows[:1], rows, rows[:2], 2)
    ray, one, R = np.ones((1, 3)), np.ones(1), np.eye(3)[None]
    covariance = covariance_by_rays(ray, one, one > 0.0, rows[:1], 1)
    row, pose = rows[:1], np.eye(6)[None]
    squared_sigmas(ray, ray, one, row, row, row, covariance, R, R, R, pose)


def compile_poses(hypotheses: str = HYPOTHESES[0]) -> None:
    """Compile the search for absolute poses by one kind of hypotheses."""
    points = 8
    point = np.random.default_rng(0).uniform(1.0, 5.0, (points, 3))
    problems = PoseProblems(
        start=np.array([0, points]),
        key=np.zeros(1, dtype=np.int64),
        q_M_I=so3.identity(1),
        origin_I=np.zeros((points, 3)),
        ray_I=point / np.linalg.norm(point, axis=1, keepdims=True),
        point_M=se3.transform(se3.identity(), point),
        keypoint=np.arange(points),
        tolerance=np.full(points, 0.01),
    )
    solve_poses(problems, hypotheses=hypotheses, max_iterations=2)
