from __future__ import annotations

import numpy as np
import pytest

from maplab_py.algorithms.landmarks.keypoint_rays import bearings
from maplab_py.algorithms.loop_closure.features import map_features
from maplab_py.errors import EstimationError
from maplab_py.sensors import Camera, Distortion, Projection
from maplab_py.sensors.projection import back_project
from maplab_py.vimap.descriptors import binary_blocks
from tests.algorithms.loop_closure.rooms import Walk, make_map

CAMERA = Camera(
    "3" * 32,
    Projection.PINHOLE,
    Distortion.RADTAN,
    np.array([460.0, 455.0, 367.0, 248.0]),
    np.array([-0.28, 0.07, 2e-4, 2e-5]),
    752,
    480,
)


def test_the_angle_of_a_pixel_is_that_of_its_neighbourhood():
    uv = np.random.default_rng(0).uniform([-3.0, -2.0], [752.0, 480.0], (2000, 2))
    ray, angle, ok = bearings(CAMERA, uv)
    exact, valid = back_project(CAMERA, uv)
    np.testing.assert_array_equal(ray, exact)
    right, below = (back_project(CAMERA, uv + step)[0] for step in ([1.0, 0.0], [0.0, 1.0]))
    area = np.linalg.norm(np.cross(right - exact, below - exact), axis=1)
    np.testing.assert_array_equal(ok, valid)
    np.testing.assert_allclose(angle[ok], np.sqrt(area[ok]), rtol=0.03)


def test_no_keypoints_have_no_rays():
    ray, angle, ok = bearings(CAMERA, np.zeros((0, 2)))
    assert len(ray) == len(angle) == len(ok) == 0


def test_missions_with_descriptors_of_different_sizes_are_not_mixed():
    vi_map, _ = make_map([Walk(room=1), Walk(room=1, mission=1, vertices=8)])
    frames, mission = vi_map.frames, vi_map.vertices.mission[vi_map.frames.vertex]
    blocks = binary_blocks(frames.keypoint_count, np.where(mission == 1, 40, 48))
    mixed = vi_map.replace(frames=frames.replace(descriptor_blocks=blocks))
    with pytest.raises(EstimationError, match="has descriptors of 40 bytes, others have 48"):
        map_features(mixed, np.arange(2))
    for mission_row, bits in ((0, 384), (1, 320)):
        assert map_features(mixed, np.array([mission_row]))[0].kind.dimensions == bits
