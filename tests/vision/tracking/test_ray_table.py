"""Rays by splines against the inverted camera model."""

import numpy as np
import pytest

from maplab_py.sensors import Camera, Distortion, Projection
from maplab_py.sensors.projection import back_project
from maplab_py.vision.tracking.ray_table import RayTable

EUROC = [458.0, 457.0, 367.0, 248.0]
CAMERAS = {
    "radtan": (Projection.PINHOLE, Distortion.RADTAN, EUROC, [-0.283, 0.074, 2e-4, 2e-5]),
    "none": (Projection.PINHOLE, Distortion.NONE, EUROC, []),
    "fov": (Projection.PINHOLE, Distortion.FOV, [260.0, 260.0, 370.0, 240.0], [0.92]),
    "wide": (Projection.PINHOLE, Distortion.EQUIDISTANT, [190.0, 190.0, 370.0, 240.0], [0.0] * 4),
    "unified": (
        Projection.UNIFIED,
        Distortion.RADTAN,
        [0.9, 600, 600, 370, 240],
        [-0.2, 0.1, 0, 0],
    ),
}


def camera(name: str) -> Camera:
    projection, distortion, intrinsics, parameters = CAMERAS[name]
    return Camera(
        "0" * 32, projection, distortion, np.array(intrinsics), np.array(parameters), 752, 480
    )


@pytest.mark.parametrize("name", CAMERAS)
def test_rays_are_those_of_the_model(name: str) -> None:
    model = camera(name)
    uv_px = np.random.default_rng(0).uniform([-2.0, -2.0], [754.0, 482.0], (500, 2))
    ray, exists = RayTable.of(model).rays(uv_px)
    expected, expected_exists = back_project(model, uv_px)
    np.testing.assert_array_equal(exists, expected_exists)
    np.testing.assert_allclose(ray, expected, atol=1e-3 / 600.0)
    np.testing.assert_allclose(np.linalg.norm(ray, axis=1), 1.0, atol=1e-12)


def test_a_model_that_cannot_be_inverted_everywhere_has_no_splines() -> None:
    assert not len(RayTable.of(camera("wide")).coefficients)
    assert RayTable.of(camera("radtan")).coefficients.shape == (65, 99, 3)


def test_pixels_far_outside_and_none() -> None:
    table = RayTable.of(camera("radtan"))
    far = np.array([[-200.0, 100.0], [300.0, 200.0]])
    np.testing.assert_array_equal(table.rays(far)[0], back_project(camera("radtan"), far)[0])
    ray, exists = table.rays(np.zeros((0, 2)))
    assert ray.shape == (0, 3)
    assert exists.shape == (0,)
