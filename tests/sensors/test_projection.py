"""Camera models against OpenCV and their own inverses."""

import dataclasses

import cv2
import numpy as np
import pytest

from maplab_py.errors import MapError
from maplab_py.sensors import Camera, Distortion, Projection
from maplab_py.sensors.camera import CAMERA_MODELS
from maplab_py.sensors.projection import back_project, is_inside_image, project, visibility_limits

INTRINSICS = {
    Projection.PINHOLE: [458.65, 457.30, 367.22, 248.38],
    Projection.UNIFIED: [0.9, 458.65, 457.30, 367.22, 248.38],
    # TUM-VI, as Basalt calibrates it
    Projection.DOUBLE_SPHERE: [-0.2, 0.59, 156.7, 156.7, 255.1, 256.6],
    Projection.EXTENDED_UNIFIED: [0.63, 1.04, 191.0, 190.9, 254.9, 256.9],
}
DISTORTION = {
    Distortion.NONE: [],
    Distortion.RADTAN: [-0.2834, 0.0740, 1.936e-4, 1.762e-5],
    Distortion.RADTAN5: [-0.2834, 0.0740, 1.936e-4, 1.762e-5, 0.011],
    # colour camera of an Azure Kinect
    Distortion.RATIONAL: [0.517, -2.67, 7.6e-4, -2.4e-4, 1.53, 0.396, -2.49, 1.458],
    Distortion.EQUIDISTANT: [-0.0132, 0.0207, -0.0128, 0.0025],
    Distortion.FOV: [0.9325],
}
MODELS = CAMERA_MODELS


def make_camera(projection: Projection, distortion: Distortion) -> Camera:
    return Camera(
        id="0" * 31 + "1",
        projection=projection,
        distortion=distortion,
        intrinsics=np.array(INTRINSICS[projection]),
        distortion_parameters=np.array(DISTORTION[distortion]),
        width_px=752,
        height_px=480,
    )


def points(count: int = 500, widest: float = 1.0) -> np.ndarray:
    rng = np.random.default_rng(7)
    xy = rng.uniform(-widest, widest, (count, 2))
    depth = rng.uniform(0.2, 20.0, (count, 1))
    return np.concatenate([xy * depth, depth], axis=1)


@pytest.mark.parametrize(("projection", "distortion"), MODELS)
def test_back_projection_inverts_projection(projection, distortion) -> None:
    camera = make_camera(projection, distortion)
    p = np.concatenate([points(300, 1.2), [[0.0, 0.0, 1.0], [1e-7, 0.0, 1.0]]])
    uv, visible = project(camera, p)
    ray, valid = back_project(camera, uv)
    assert visible.all()
    assert valid.all()
    assert np.max(np.abs(ray - p / np.linalg.norm(p, axis=1, keepdims=True))) < 1e-9


def test_fov_reaches_the_radius_of_the_tango_camera() -> None:
    camera = make_camera(Projection.PINHOLE, Distortion.FOV)
    angle = np.linspace(0.0, 2 * np.pi, 100)
    p = np.stack([2.84 * np.cos(angle), 2.84 * np.sin(angle), np.ones(100)], axis=1)
    ray, valid = back_project(camera, project(camera, p)[0])
    assert valid.all()
    assert np.max(np.abs(ray / ray[:, 2:] - p)) < 1e-12 * 10


def test_fov_formula_is_maplabs() -> None:
    camera = make_camera(Projection.PINHOLE, Distortion.FOV)
    w, (fu, fv, cu, cv) = 0.9325, camera.intrinsics
    uv, _ = project(camera, np.array([0.3, -0.4, 1.0]))
    scale = np.arctan(2 * 0.5 * np.tan(w / 2)) / w / 0.5
    assert uv == pytest.approx([fu * scale * 0.3 + cu, -fv * scale * 0.4 + cv], abs=1e-12)


@pytest.mark.parametrize("w", [0.0, 1e-5, 0.99e-4, 1.01e-4, 1e-3])
def test_fov_with_almost_no_distortion_is_continuous(w) -> None:
    camera = dataclasses.replace(
        make_camera(Projection.PINHOLE, Distortion.FOV), distortion_parameters=np.array([w])
    )
    straight = make_camera(Projection.PINHOLE, Distortion.NONE)
    p = points(50)
    uv, _ = project(camera, p)
    assert np.allclose(uv, project(straight, p)[0], atol=500 * w * w + 1e-9)
    assert np.allclose(back_project(camera, uv)[0], p / np.linalg.norm(p, axis=1)[:, None])


@pytest.mark.parametrize("distortion", [Distortion.RADTAN, Distortion.RADTAN5, Distortion.RATIONAL])
def test_brown_models_agree_with_opencv(distortion) -> None:
    camera = make_camera(Projection.PINHOLE, distortion)
    p = points()
    K = np.array([[458.65, 0, 367.22], [0, 457.30, 248.38], [0, 0, 1.0]])
    uv, _ = cv2.projectPoints(p, np.zeros(3), np.zeros(3), K, camera.distortion_parameters)
    assert np.max(np.abs(project(camera, p)[0] - uv[:, 0])) < 1e-9


def test_equidistant_agrees_with_opencv() -> None:
    camera = make_camera(Projection.PINHOLE, Distortion.EQUIDISTANT)
    p = points()
    K = np.array([[458.65, 0, 367.22], [0, 457.30, 248.38], [0, 0, 1.0]])
    uv, _ = cv2.fisheye.projectPoints(
        p[:, None], np.zeros(3), np.zeros(3), K, camera.distortion_parameters
    )
    assert np.max(np.abs(project(camera, p)[0] - uv[:, 0])) < 1e-9


def test_points_behind_are_not_visible_and_stay_finite() -> None:
    for projection, distortion in MODELS:
        camera = make_camera(projection, distortion)
        p = np.array([[0.1, 0.2, -1.0], [0.0, 0.0, 0.0], [0.1, 0.0, 1.0], [0.0, 0.0, -3.0]])
        uv, visible = project(camera, p)
        assert visible.tolist() == [False, False, True, False]
        assert np.isfinite(uv).all()


def test_unified_sees_sideways_and_a_little_behind() -> None:
    camera = make_camera(Projection.UNIFIED, Distortion.NONE)
    p = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, -0.5], [0.1, 0.0, -1.0]])
    uv, visible = project(camera, p)
    assert visible.tolist() == [True, True, False]
    ray, valid = back_project(camera, uv)
    assert valid[:2].all()
    assert np.allclose(ray[:2], p[:2] / np.linalg.norm(p[:2], axis=1)[:, None])


def rays_in_all_directions(count: int = 4000) -> np.ndarray:
    ray = np.random.default_rng(3).normal(size=(count, 3))
    return ray / np.linalg.norm(ray, axis=1, keepdims=True)


@pytest.mark.parametrize(
    ("projection", "mirror"),
    [
        (Projection.DOUBLE_SPHERE, [-0.2, 0.59]),
        (Projection.DOUBLE_SPHERE, [0.3, 0.4]),
        (Projection.DOUBLE_SPHERE, [-0.5, 0.0]),
        (Projection.DOUBLE_SPHERE, [0.8, 0.9]),
        (Projection.EXTENDED_UNIFIED, [0.63, 1.04]),
        (Projection.EXTENDED_UNIFIED, [0.4, 2.0]),
        (Projection.EXTENDED_UNIFIED, [0.8, 0.7]),
    ],
)
def test_every_visible_point_has_its_ray(projection, mirror) -> None:
    intrinsics = np.array([*mirror, 200.0, 200.0, 256.0, 256.0])
    camera = dataclasses.replace(make_camera(projection, Distortion.NONE), intrinsics=intrinsics)
    ray = rays_in_all_directions()
    uv, visible = project(camera, ray)
    assert np.all(visible[ray[:, 2] > 0.5])
    assert not visible.all()
    shift, least, cone, radius = visibility_limits(camera)
    z, across = ray[:, 2], np.hypot(ray[:, 0], ray[:, 1])
    assert np.array_equal(
        visible, (z + shift > least) & (z > -cone) & (across < radius * (z + shift))
    )
    inner = visible & (np.hypot(*(uv - 256.0).T) < 1e4)
    back, valid = back_project(camera, uv[inner])
    assert valid.all()
    assert np.max(np.abs(back - ray[inner])) < 1e-7


def test_double_sphere_and_extended_unified_become_the_unified_model() -> None:
    p = points(100)
    unified = make_camera(Projection.UNIFIED, Distortion.NONE)
    double = make_camera(Projection.DOUBLE_SPHERE, Distortion.NONE)
    extended = make_camera(Projection.EXTENDED_UNIFIED, Distortion.NONE)
    xi, *pinhole = unified.intrinsics
    expected = project(unified, p)[0]
    double = dataclasses.replace(double, intrinsics=np.array([xi, 0.0, *pinhole]))
    assert np.max(np.abs(project(double, p)[0] - expected)) < 1e-10
    # z + xi |p| = (1 + xi) (alpha |p| + (1 - alpha) z) with alpha = xi / (1 + xi)
    focal = np.array(pinhole[:2]) / (1.0 + xi)
    intrinsics = np.array([xi / (1.0 + xi), 1.0, *focal, *pinhole[2:]])
    extended = dataclasses.replace(extended, intrinsics=intrinsics)
    assert np.max(np.abs(project(extended, p)[0] - expected)) < 1e-10
    assert extended.central_focal_px == pytest.approx(unified.central_focal_px)
    assert double.central_focal_px == pytest.approx(unified.central_focal_px)


def test_rational_model_ends_before_its_pole() -> None:
    camera = dataclasses.replace(
        make_camera(Projection.PINHOLE, Distortion.RATIONAL),
        distortion_parameters=np.array([0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0]),
    )
    # r / (1 - r^2)
    p = np.array([[0.9, 0.0, 1.0], [1.1, 0.0, 1.0]])
    assert project(camera, p)[1].tolist() == [True, False]


@pytest.mark.parametrize(
    ("projection", "distortion", "mirror", "message"),
    [
        (Projection.DOUBLE_SPHERE, Distortion.RADTAN, [0.1, 0.5], "takes no distortion"),
        (Projection.EXTENDED_UNIFIED, Distortion.FOV, [0.5, 1.0], "takes no distortion"),
        (Projection.DOUBLE_SPHERE, Distortion.NONE, [-1.0, 0.5], "-1 < xi <= 1"),
        (Projection.DOUBLE_SPHERE, Distortion.NONE, [0.1, 1.5], "0 <= alpha <= 1"),
        (Projection.EXTENDED_UNIFIED, Distortion.NONE, [0.5, -0.1], "beta > 0"),
        (Projection.EXTENDED_UNIFIED, Distortion.NONE, [np.nan, 1.0], "0 <= alpha <= 1"),
        (Projection.EXTENDED_UNIFIED, Distortion.NONE, [0.5], "6 . 0 parameters, not 5"),
    ],
)
def test_cameras_without_meaning_are_refused(projection, distortion, mirror, message) -> None:
    intrinsics = np.array([*mirror, 200.0, 200.0, 256.0, 256.0])
    parameters = np.array(DISTORTION[distortion])
    with pytest.raises(MapError, match=message):
        Camera("0" * 32, projection, distortion, intrinsics, parameters, 512, 512)


def test_folded_distortion_is_not_visible() -> None:
    camera = dataclasses.replace(
        make_camera(Projection.PINHOLE, Distortion.RADTAN),
        distortion_parameters=np.array([-0.3, 0.0, 0.0, 0.0]),
    )
    # r (1 - 0.3 r^2) grows up to r = 1.054 only
    p = np.array([[1.0, 0.0, 1.0], [1.1, 0.0, 1.0], [1.8, 0.0, 1.0]])
    assert project(camera, p)[1].tolist() == [True, False, False]
    beyond = camera.intrinsics[2] + camera.intrinsics[0] * np.array([0.70, 0.71])
    uv = np.stack([beyond, np.full(2, camera.intrinsics[3])], axis=1)
    assert back_project(camera, uv)[1].tolist() == [True, False]


def test_pixels_without_a_ray_are_flagged() -> None:
    camera = make_camera(Projection.PINHOLE, Distortion.FOV)
    ray, valid = back_project(camera, np.array([[1e4, 0.0], [np.nan, 0.0], [367.0, 248.0]]))
    assert valid.tolist() == [False, False, True]
    assert np.isfinite(ray).all()


def test_inside_image_is_half_open() -> None:
    camera = make_camera(Projection.PINHOLE, Distortion.NONE)
    uv = np.array([[0.0, 0.0], [751.9, 479.9], [752.0, 10.0], [-0.1, 5.0], [5.0, 5.0]])
    assert is_inside_image(camera, uv).tolist() == [True, True, False, False, True]
    assert is_inside_image(camera, uv, 10.0).tolist() == [False] * 5
