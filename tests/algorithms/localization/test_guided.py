"""Guided matching against a comparison of every keypoint with every landmark."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from maplab_py.algorithms.localization.database import (
    LocalizationMap,
    database_of_map,
    database_of_summary,
)
from maplab_py.algorithms.localization.guided import (
    compile_kernels,
    guided_matches,
    landmarks_in_view,
    least_distances,
    near_pairs,
    points_near,
)
from maplab_py.algorithms.localization.localizer import Localizer
from maplab_py.algorithms.localization.options import LocalizationOptions
from maplab_py.array_types import F64, I64
from maplab_py.frontend.localization.keypoints import FrameKeypoints, frame_keypoints
from maplab_py.frontend.odometry import Odometry
from maplab_py.geometry import se3
from maplab_py.interop.recordings.protocol import ImuBatch
from maplab_py.interop.recordings.stream import EventStream
from tests.frontend.localization.places import place, summary

RADIUS_PX = 15.0


@functools.cache
def frames() -> list[tuple[FrameKeypoints, F64]]:
    """Return the keypoints of frames and their true poses (7,), with a second camera made up."""
    recording = place().recording()
    odometry = Odometry(recording.device, make_starter=place().start)
    result = []
    for event in EventStream(recording):
        updates = (
            odometry.push_imu(event) if isinstance(event, ImuBatch) else odometry.push_tracks(event)
        )
        for update in updates:
            seen = frame_keypoints(update, recording.device)
            row = int(np.searchsorted(place().times_ns, update.time_ns))
            result.append((seen, place().T_G_I[row]))
    return [pair for pair in result if len(pair[0]) > 30][::5]


def brute_force(
    database: LocalizationMap, T_G_I: F64, distance: F64, origin_I: F64, ray_I: F64, radius: F64
) -> set[tuple[int, int]]:
    """Return the pairs within the radius whose landmark may be visible; distance (N, O) of descriptors."""
    s, pairs = database.sights, set()
    back = T_G_I[4:] - database.p_G
    range_m = np.linalg.norm(back, axis=1)
    visible = (range_m < 2.0 * s.farthest_m) & (2.0 * range_m > s.nearest_m)
    visible &= np.einsum("li,li->l", s.direction, back) > s.least_cosine * range_m
    p_I = se3.transform(se3.inverse(T_G_I), database.p_G)
    for n in range(len(ray_I)):
        toward = p_I - origin_I[n]
        cosine = toward @ ray_I[n] / np.linalg.norm(toward, axis=1)
        for landmark in np.flatnonzero(visible & (cosine > np.cos(radius[n]))).tolist():
            if distance[n, database.descriptors.label == landmark].min() <= LIMIT:
                pairs.add((n, landmark))
    return pairs


LIMIT = 90.0
"""Bits of descriptors; projected ones are compared with another number."""


@pytest.mark.parametrize("kind", ["map", "summary"])
@pytest.mark.parametrize("cameras", [1, 2])
def test_it_returns_all_similar_pairs_near_the_pose(kind: str, cameras: int) -> None:
    database = database_of_map(place().vi_map) if kind == "map" else database_of_summary(summary())
    localizer = Localizer(database, LocalizationOptions())
    count = 0
    for seen, T_G_I in frames():
        described = localizer.described(seen.descriptors)
        origin_I, radius = seen.origin_I.copy(), RADIUS_PX * seen.rad_per_px
        if cameras == 2:
            origin_I[::2] += [0.1, 0.0, 0.02]
        if database.has_descriptors:
            a, b = (
                np.unpackbits(np.ascontiguousarray(w).view(np.uint8), axis=1).astype(np.float64)
                for w in (described.words, database.descriptors.words)
            )
            distance = a @ (1.0 - b.T) + (1.0 - a) @ b.T
        else:
            step = described.projected[:, None] - database.descriptors.projected[None]
            distance = np.sum(step * step, axis=2)
        # the same limit for both kinds
        scale = LIMIT / (LIMIT if database.has_descriptors else float(np.median(distance)))
        keypoint, landmark = guided_matches(
            database, T_G_I, projected=described.projected, words=described.words,
            origin_I=origin_I, ray_I=seen.ray_I, radius_rad=radius, max_distance=LIMIT / scale,
        )  # fmt: skip
        pairs = list(zip(keypoint.tolist(), landmark.tolist(), strict=True))
        expected = brute_force(database, T_G_I, distance * scale, origin_I, seen.ray_I, radius)
        assert pairs == sorted(expected)
        count += len(pairs)
    assert count > 100


def test_pairs_are_all_returned_however_many_they_are() -> None:
    ray, toward = np.tile([[0.0, 0.0, 1.0]], (3, 1)), np.tile([[0.0, 0.0, 1.0]], (200, 1))
    first: I64 = np.zeros(3, dtype=np.int64)
    key, point = near_pairs(ray, np.full(3, 0.9), first, first + 200, toward)
    np.testing.assert_array_equal(key, np.repeat(np.arange(3), 200))
    np.testing.assert_array_equal(point, np.tile(np.arange(200), 3))


def test_nothing_is_compiled_after_the_warmup() -> None:
    compile_kernels()
    kernels = (landmarks_in_view, points_near, least_distances)
    before = [list(kernel.signatures) for kernel in kernels]
    assert all(before)
    localizer = Localizer(database_of_summary(summary()), LocalizationOptions())
    seen, T_G_I = frames()[0]
    described = localizer.described(seen.descriptors)
    guided_matches(
        database_of_summary(summary()), T_G_I, projected=described.projected,
        words=described.words, origin_I=seen.origin_I, ray_I=seen.ray_I,
        radius_rad=RADIUS_PX * seen.rad_per_px, max_distance=1.0,
    )  # fmt: skip
    assert [list(kernel.signatures) for kernel in kernels] == before
