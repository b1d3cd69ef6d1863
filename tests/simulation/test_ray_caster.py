"""The compiled ray caster shows what a plain one in numpy shows, in every situation."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest

from maplab_py.geometry import se3, so3
from maplab_py.sensors import Camera, Distortion, Projection
from maplab_py.simulation.imaging import pixel_rays
from maplab_py.simulation.ray_caster import RayCaster, painted_boxes
from maplab_py.simulation.scenario import ImageOptions
from maplab_py.simulation.scene import Scene, make_scene
from tests.simulation.slow_renderer import render_slowly

ROOM = np.array([[-4.0, -3.0, 0.0], [4.0, 3.0, 3.0]])
FOCAL_PX = 190.0
GREY_TOLERANCE = 0.02
DEPTH_TOLERANCE = 1e-5
LEVEL = so3.from_matrix(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))


def _camera(width_px: int = 376) -> Camera:
    return Camera(
        "0" * 32, Projection.PINHOLE, Distortion.RADTAN,
        np.array([FOCAL_PX, FOCAL_PX, 0.5 * width_px, 120.0]),
        np.array([-0.28, 0.07, 2e-4, 2e-5]), width_px, 240,
    )  # fmt: skip


@cache
def _scene(boxes: int, seed: int = 0) -> Scene:
    rng = np.random.default_rng(seed)
    middle, half = rng.uniform(ROOM[0], ROOM[1], (boxes, 3)), rng.uniform(0.05, 0.4, (boxes, 3))
    corners = np.stack([middle - half, middle + half], axis=1)
    return make_scene(ROOM, corners, ImageOptions(texel_m=0.01), rng)


def _pose(yaw: float, pitch: float, roll: float, *position: float) -> np.ndarray:
    turn = so3.exp(np.array([[0.0, 0.0, yaw], [0.0, pitch, 0.0], [roll, 0.0, 0.0]]))
    q = so3.multiply(so3.multiply(turn[0], so3.multiply(turn[1], turn[2])), LEVEL)
    return se3.make(q, np.array(position))[None]


def _compare(scene: Scene, camera: Camera, T_G_C: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    rays = pixel_rays(camera)
    expected, expected_depth = render_slowly(scene, rays, FOCAL_PX, T_G_C)
    grey, depth = RayCaster.of(painted_boxes(scene), rays, FOCAL_PX).render(T_G_C)
    np.testing.assert_allclose(depth, expected_depth, rtol=DEPTH_TOLERANCE)
    np.testing.assert_allclose(grey, expected, atol=GREY_TOLERANCE, rtol=0.0)
    return grey, depth


@pytest.mark.parametrize("boxes", [0, 5, 60])
@pytest.mark.parametrize(
    "T_G_C",
    [
        _pose(0.3, 0.1, 0.05, 0.2, -0.4, 1.4),
        _pose(2.8, -0.4, 1.2, -2.0, 1.0, 0.7),
        _pose(-1.4, 1.1, 0.0, 3.9, 2.9, 2.9),  # a grazing view out of a corner
    ],
)
def test_grey_values_and_depth_are_those_of_the_plain_ray_caster(
    boxes: int, T_G_C: np.ndarray
) -> None:
    grey, depth = _compare(_scene(boxes), _camera(), T_G_C)
    assert grey.std() > 20.0
    assert depth.min() > 0.0


def _without_selection(caster: RayCaster) -> RayCaster:
    """Return a ray caster that tests every ray against every box: its cones contain all directions."""
    whole = np.array([0.0, 0.0, 0.0, -1.0, 0.0], dtype=np.float32)
    rays = caster.rays
    row_cones, cones = np.empty_like(rays.row_cones), np.empty_like(rays.cones)
    row_cones[:], cones[:] = whole, whole
    return dataclasses.replace(caster, rays=rays._replace(row_cones=row_cones, cones=cones))


def _poses_near_boxes(scene: Scene, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return poses (count, 7) in the room, a third of them on the spheres round boxes, one in a box."""
    places = rng.uniform(ROOM[0], ROOM[1], (count, 3))
    boxes = scene.boxes[1 : 1 + count // 3]
    half = 0.5 * (boxes[:, 1] - boxes[:, 0])
    away = rng.standard_normal((len(boxes), 3))
    away *= np.linalg.norm(half, axis=1, keepdims=True) / np.linalg.norm(away, axis=1)[:, None]
    places[: len(boxes)] = boxes.mean(axis=1) + away
    places[-1] = scene.boxes[1].mean(axis=0)
    return np.concatenate([_pose(*rng.uniform(-3.2, 3.2, 3), *place) for place in places])


@pytest.mark.parametrize("seed", range(3))
def test_selection_of_boxes_changes_no_bit(seed: int) -> None:
    scene, rng = _scene(150, seed), np.random.default_rng(seed)
    height, width = 48, 300
    x, y = np.meshgrid(np.linspace(-5.0, 5.0, width), np.linspace(-3.0, 3.0, height))
    wide = np.stack([x, y], axis=2)
    one_sided = np.abs(wide) * [1.0, -1.0]
    one_sided[10:20, :200] = np.nan
    narrow = 0.04 * wide[:, :129]  # the last tile has one ray
    poses = _poses_near_boxes(scene, 12, rng)
    rolling = _poses_near_boxes(scene, height, rng)
    for rays in (wide, one_sided, narrow):
        caster = RayCaster.of(painted_boxes(scene), rays, 40.0)
        exhaustive = _without_selection(caster)
        for T_G_C in (*poses[:, None], rolling):
            images, expected = caster.render(T_G_C), exhaustive.render(T_G_C)
            np.testing.assert_array_equal(np.array(images), np.array(expected))


def test_rays_along_the_axes_and_borders_of_surfaces() -> None:
    # straight ahead: two coordinates of the middle ray vanish, and the corners of the room are in view
    grey, _ = _compare(_scene(3), _camera(375), _pose(0.0, 0.0, 0.0, -3.5, 0.0, 1.5))
    assert grey.std() > 20.0


def test_a_rolling_shutter_has_a_pose_for_each_row() -> None:
    yaw = np.linspace(0.0, 0.2, 240)
    T_G_C = np.concatenate([_pose(y, 0.1, 0.0, 0.2 + y, 0.1, 1.4) for y in yaw])
    rolling, _ = _compare(_scene(5), _camera(), T_G_C)
    at_rest, _ = _compare(_scene(5), _camera(), T_G_C[:1])
    np.testing.assert_array_equal(rolling[0], at_rest[0])
    assert np.abs(rolling[-1] - at_rest[-1]).mean() > 5.0


def test_pixels_without_ray_are_black_and_have_no_depth() -> None:
    camera, scene = _camera(), _scene(5)
    rays = pixel_rays(camera)
    rays[:40, 100:230] = np.nan
    grey, depth = RayCaster.of(painted_boxes(scene), rays, FOCAL_PX).render(
        _pose(0.3, 0.1, 0.05, 0.2, -0.4, 1.4)
    )
    assert not grey[:40, 100:230].any()
    assert not depth[:40, 100:230].any()
    assert depth[:40, :100].min() > 0.0


def test_images_add_up_with_their_weights() -> None:
    caster = RayCaster.of(painted_boxes(_scene(5)), pixel_rays(_camera()), FOCAL_PX)
    poses = [_pose(yaw, 0.1, 0.0, 0.2, -0.4, 1.4) for yaw in (0.1, 0.3)]
    total, depth = np.zeros((240, 376), dtype=np.float32), np.zeros((240, 376), dtype=np.float32)
    for pose, weight in zip(poses, (0.25, 0.75), strict=True):
        caster.add(pose, weight, total, depth)
    (first, _), (second, second_depth) = (caster.render(pose) for pose in poses)
    np.testing.assert_allclose(total, 0.25 * first + 0.75 * second, atol=1e-4)
    np.testing.assert_array_equal(depth, second_depth)


@pytest.mark.parametrize("place", [(9.0, 0.0, 1.0), (np.nan, 0.0, 1.0), (1e30, -1e30, 0.0)])
def test_a_camera_in_an_impossible_place_reads_nothing_beyond_the_textures(
    place: tuple[float, float, float],
) -> None:
    caster = RayCaster.of(painted_boxes(_scene(5)), pixel_rays(_camera()), FOCAL_PX)
    grey, _ = caster.render(_pose(0.3, 0.1, 0.0, *place))
    known = grey[np.isfinite(grey)]
    assert np.all((known >= 0.0) & (known <= 255.0))
