"""Rectification of every camera model: rows, disparities, and depth carried back to the image."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from maplab_py.algorithms.dense.pinhole import ImageMap, undistorted
from maplab_py.algorithms.dense.rectification import StereoPair, stereo_pairs
from maplab_py.array_types import F64
from maplab_py.geometry import se3, so3
from maplab_py.sensors import Camera, CameraRig, Distortion, Projection
from maplab_py.sensors.camera import CAMERA_MODELS
from maplab_py.sensors.projection import back_project, is_inside_image, project

WIDTH, HEIGHT = 160, 120
PARAMETERS = {
    Distortion.NONE: [],
    Distortion.RADTAN: [-0.28, 0.07, 2e-4, 2e-5],
    Distortion.RADTAN5: [-0.28, 0.07, 2e-4, 2e-5, 0.01],
    Distortion.RATIONAL: [0.3, -0.1, 2e-4, 2e-5, 0.02, 0.5, 0.05, 0.01],
    Distortion.EQUIDISTANT: [-0.01, 0.02, -0.01, 0.002],
    Distortion.FOV: [0.9],
}
MIRROR = {
    Projection.PINHOLE: [],
    Projection.UNIFIED: [0.7],
    Projection.DOUBLE_SPHERE: [-0.2, 0.6],
    Projection.EXTENDED_UNIFIED: [0.6, 1.1],
}
MODELS = list(CAMERA_MODELS)


def make_camera(number: int, projection: Projection, distortion: Distortion) -> Camera:
    mirror = MIRROR[projection]
    focal = 130.0 if mirror else 80.0
    return Camera(
        f"{number:032x}",
        projection,
        distortion,
        np.array([*mirror, focal, focal + 1.0, 80.0 + number, 59.0]),
        np.array(PARAMETERS[distortion]),
        WIDTH,
        HEIGHT,
    )


def make_rig(
    model: tuple[Projection, Distortion] = MODELS[1],
    positions: Any = ((0.0, 0.0, 0.0), (0.1, 0.004, -0.003)),
    turns: Any = ((0.01, -0.02, 0.005), (-0.01, 0.03, -0.01)),
) -> CameraRig:
    T_B_C = [
        se3.make(so3.exp(np.array(t)), np.array(p)) for t, p in zip(turns, positions, strict=True)
    ]
    cameras = tuple(make_camera(number, *model) for number in range(len(T_B_C)))
    return CameraRig("0" * 32, cameras, np.array(T_B_C))


def pairs_of(rig: CameraRig) -> tuple[list[StereoPair], list[str]]:
    return stereo_pairs(rig, min_baseline_m=0.02, max_angle_rad=0.785)


def sampled(image: ImageMap, u: Any, v: Any) -> F64:
    """Return where rectified pixels (u, v), not whole, lie in the image."""
    import cv2

    arguments = u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR
    return np.stack([cv2.remap(m, *arguments)[:, 0] for m in (image.u, image.v)], axis=-1)


@pytest.mark.parametrize("model", MODELS, ids=lambda model: f"{model[0].value}-{model[1].value}")
def test_a_point_is_in_one_row_at_the_disparity_of_its_depth(
    model: tuple[Projection, Distortion],
) -> None:
    rig = make_rig(model)
    (pair,), reasons = pairs_of(rig)
    assert (pair.left, pair.right, reasons) == (0, 1, [])
    rng = np.random.default_rng(5)
    p_P = rng.uniform([-1.0, -0.7, 2.0], [1.0, 0.7, 6.0], (400, 3))
    left = p_P @ pair.R_C_P.T
    right = se3.transform(se3.relative(rig.T_B_C[1], rig.T_B_C[0]), left)
    u, v, _ = pair.pinhole.pixels(p_P)
    disparity = pair.pinhole.focal_px * pair.baseline_m / p_P[:, 2]
    size = np.array([pair.pinhole.width_px, pair.pinhole.height_px])
    inside = np.all(
        (np.stack([u - disparity, v], 1) > 2) & (np.stack([u, v], 1) < size - 3), axis=1
    )
    assert np.count_nonzero(inside) > 100
    for image_map, camera, p_C, shift in (
        (pair.to_left, rig.cameras[0], left, 0.0),
        (pair.to_right, rig.cameras[1], right, disparity),
    ):
        uv, visible = project(camera, p_C)
        found = sampled(image_map, u - shift, v)
        chosen = inside & visible & is_inside_image(camera, uv, 2.0)
        assert np.abs(found - uv)[chosen].max() < 0.05


@pytest.mark.parametrize("model", MODELS, ids=lambda model: f"{model[0].value}-{model[1].value}")
def test_depth_of_a_plane_returns_to_the_distorted_image(
    model: tuple[Projection, Distortion],
) -> None:
    rig = make_rig(model)
    (pair,), _ = pairs_of(rig)
    normal_C, offset = np.array([0.2, -0.1, 1.0]), 3.0  # normal . p = offset
    rays_P = pair.pinhole.rays()
    depth_P = (offset / (rays_P @ pair.R_C_P.T @ normal_C)).astype(np.float32)
    depth = pair.depth_of_left(depth_P)
    v, u = np.nonzero(depth)
    assert len(u) > 0.4 * depth.size
    rays, _ = back_project(rig.cameras[0], np.stack([u, v], axis=1))
    expected = offset / (rays @ normal_C) * rays[:, 2]
    np.testing.assert_allclose(depth[v, u], expected, rtol=0.01)
    assert np.median(np.abs(depth[v, u] / expected - 1.0)) < 1e-4
    pinhole, image_map = undistorted(rig.cameras[0])
    flat = image_map.depth(depth)
    expected_flat = offset / (pinhole.rays() @ normal_C)
    known = flat > 0.0
    assert np.count_nonzero(known) > 0.4 * depth.size
    np.testing.assert_allclose(flat[known], expected_flat[known], rtol=0.02)


def test_all_rectified_pixels_of_a_pinhole_pair_are_seen() -> None:
    (pair,), _ = pairs_of(make_rig())
    assert pair.to_left.valid.mean() > 0.99
    assert pair.to_right.valid.mean() > 0.99


def test_left_is_where_the_geometry_says() -> None:
    (pair,), _ = pairs_of(make_rig(positions=((0.1, 0.0, 0.0), (0.0, 0.0, 0.0))))
    assert (pair.left, pair.right) == (1, 0)


def test_cameras_above_each_other_are_a_pair() -> None:
    rig = make_rig(positions=((0.0, 0.1, 0.0), (0.0, 0.0, 0.0)))
    (pair,), _ = pairs_of(rig)
    assert (pair.left, pair.right) == (1, 0)
    assert (pair.pinhole.width_px, pair.pinhole.height_px) == (HEIGHT, WIDTH)
    depth_P = np.full((WIDTH, HEIGHT), 2.0, dtype=np.float32)
    depth = pair.depth_of_left(depth_P)
    assert (depth > 0).mean() > 0.4
    np.testing.assert_allclose(depth[depth > 0], 2.0, rtol=0.1)


@pytest.mark.parametrize(
    ("positions", "turns", "reason"),
    [
        (((0, 0, 0), (0.01, 0, 0)), ((0, 0, 0), (0, 0, 0)), "--dense_stereo_min_baseline"),
        (((0, 0, 0), (0.1, 0, 0)), ((0, 0, 0), (0, 0.9, 0)), "max_angle_between_opt_axes"),
        (((0, 0, 0), (0.02, 0, 0.1)), ((0, 0, 0), (0, 0, 0)), "epipole"),
    ],
)
def test_unsuitable_pairs_are_left_out_with_the_reason(
    positions: Any, turns: Any, reason: str
) -> None:
    rig = make_rig(positions=np.array(positions, float), turns=np.array(turns, float))
    pairs, reasons = pairs_of(rig)
    assert pairs == []
    assert len(reasons) == 1
    assert reason in reasons[0]


def test_edges_of_depth_are_not_blurred() -> None:
    depth = np.full((20, 20), 1.0, dtype=np.float32)
    depth[:, 10:] = 4.0
    depth[:5] = 0.0
    u, v = np.meshgrid(np.arange(19) + 0.4, np.arange(19) + 0.4)
    image = ImageMap.of(u.astype(np.float32), v.astype(np.float32), np.ones(u.shape, dtype=bool))
    assert set(np.unique(image.depth(depth)).tolist()) == {0.0, 1.0, 4.0}
