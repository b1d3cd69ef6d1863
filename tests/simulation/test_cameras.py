"""The simulator's projection against OpenCV's and against the estimator's."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from maplab_py.sensors import Camera, CameraRig, Distortion, Projection
from maplab_py.sensors.camera import CAMERA_MODELS
from maplab_py.sensors.projection import project
from maplab_py.simulation.cameras import field_of_view_radius, pixels_of
from maplab_py.simulation.scenario import CameraOptions, Scenario, SessionOptions
from maplab_py.simulation.simulate import simulate
from maplab_py.simulation.truth import true_map

PARAMETERS = {
    Distortion.NONE: [],
    Distortion.RADTAN: [-0.28, 0.07, 2e-4, 2e-5],
    Distortion.RADTAN5: [-0.28, 0.07, 2e-4, 2e-5, -0.01],
    Distortion.RATIONAL: [0.3, 0.02, 2e-4, 2e-5, 1e-3, 0.6, 0.05, 2e-3],
    Distortion.EQUIDISTANT: [-0.02, 0.01, -0.006, 0.001],
    Distortion.FOV: [0.92],
}
PINHOLE = [380.0, 390.0, 376.0, 240.0]
MIRROR = {
    Projection.PINHOLE: [],
    Projection.UNIFIED: [0.8],
    Projection.DOUBLE_SPHERE: [-0.2, 0.6],
    Projection.EXTENDED_UNIFIED: [0.6, 1.1],
}


def _camera(projection: Projection, distortion: Distortion) -> Camera:
    intrinsics = [*MIRROR[projection], *PINHOLE]
    return Camera(
        "0" * 32,
        projection,
        distortion,
        np.array(intrinsics),
        np.array(PARAMETERS[distortion]),
        752,
        480,
    )


def _points() -> np.ndarray:
    rng = np.random.default_rng(0)
    return rng.uniform([-2.0, -1.5, 2.0], [2.0, 1.5, 8.0], (500, 3))


@pytest.mark.parametrize(("projection", "distortion"), CAMERA_MODELS)
def test_agrees_with_the_estimators(projection: Projection, distortion: Distortion) -> None:
    camera = _camera(projection, distortion)
    expected, visible = project(camera, _points())
    assert visible.all()
    np.testing.assert_allclose(pixels_of(camera, _points()), expected, atol=1e-9)


@pytest.mark.parametrize("distortion", [Distortion.NONE, Distortion.RADTAN])
def test_agrees_with_opencv(distortion: Distortion) -> None:
    import cv2

    camera = _camera(Projection.PINHOLE, distortion)
    K = np.array([[380.0, 0, 376], [0, 390, 240], [0, 0, 1]])
    given = np.array(PARAMETERS[distortion]) if PARAMETERS[distortion] else None
    expected = cv2.projectPoints(_points(), np.zeros(3), np.zeros(3), K, given)[0][:, 0]
    np.testing.assert_allclose(pixels_of(camera, _points()), expected, atol=1e-9)


def test_agrees_with_opencv_fisheye() -> None:
    import cv2

    camera = _camera(Projection.PINHOLE, Distortion.EQUIDISTANT)
    K = np.array([[380.0, 0, 376], [0, 390, 240], [0, 0, 1]])
    k = np.array(PARAMETERS[Distortion.EQUIDISTANT])
    points = _points()[:, None]
    expected = cv2.fisheye.projectPoints(points, np.zeros(3), np.zeros(3), K, k)[0][:, 0]
    np.testing.assert_allclose(pixels_of(camera, _points()), expected, atol=1e-9)


def test_field_of_view_ends_where_the_image_turns_back() -> None:
    folding = np.array([-0.28, 0.0, 0.0, 0.0])
    camera = dataclasses.replace(
        _camera(Projection.PINHOLE, Distortion.RADTAN), distortion_parameters=folding
    )
    limit = field_of_view_radius(camera)
    # d/dr (r - 0.28 r^3) = 0
    assert limit == pytest.approx(np.sqrt(1.0 / 0.84), abs=2e-3)
    radius = np.linspace(0.01, limit, 50)
    u = pixels_of(camera, np.stack([radius, 0 * radius, 0 * radius + 1], axis=1))[:, 0]
    assert np.all(np.diff(u) > 0.0)
    beyond = pixels_of(camera, np.array([[limit * 1.1, 0, 1.0], [limit, 0, 1.0]]))[:, 0]
    assert beyond[0] < beyond[1]


def test_the_truth_of_a_session_holds_cameras_with_the_most_parameters() -> None:
    cameras = tuple(
        CameraOptions(
            projection=projection.value,
            distortion=distortion.value,
            intrinsics=(*MIRROR[projection], *PINHOLE),
            distortion_parameters=tuple(PARAMETERS[distortion]),
        )
        for projection, distortion in (
            (Projection.UNIFIED, Distortion.RATIONAL),
            (Projection.DOUBLE_SPHERE, Distortion.NONE),
        )
    )
    scenario = dataclasses.replace(
        Scenario(), sessions=(SessionOptions(duration_s=2.0),), cameras=cameras
    )
    data = simulate(scenario)
    rig = next(
        sensor
        for sensor in true_map(data.maps[0], data.truth).sensors.sensors.values()
        if isinstance(sensor, CameraRig)
    )
    for camera, options in zip(rig.cameras, cameras, strict=True):
        assert camera.intrinsics.tolist() == list(options.intrinsics)
        assert camera.distortion_parameters.tolist() == list(options.distortion_parameters)
