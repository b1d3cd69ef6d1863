"""The compiled ray caster against a plain one, and images against depth, geometry and OpenCV."""

import dataclasses
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from maplab_py.console.session.session import Session
from maplab_py.geometry import se3, so3
from maplab_py.sensors import Camera, Distortion, Projection
from maplab_py.simulation import scenario as sim
from maplab_py.simulation import shading_kernels
from maplab_py.simulation.cameras import pixels_of
from maplab_py.simulation.imaging import Brightness, Imager, pixel_rays
from maplab_py.simulation.raw_data import write_mesh
from maplab_py.simulation.ray_caster import RayCaster, painted_boxes
from maplab_py.simulation.scene import Scene, make_scene
from maplab_py.simulation.simulate import SimulatedData, simulate
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
    return make_scene(ROOM, corners, sim.ImageOptions(texel_m=0.01), rng)


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


SMALL_CAMERA = sim.CameraOptions(
    intrinsics=(190.0, 190.0, 188.0, 120.0), width_px=376, height_px=240, position_m=(0.05, 0.06, 0.0)
)  # fmt: skip
STEREO = sim.Scenario(
    world=sim.WorldOptions(rooms=2, landmarks_per_room=1500),
    cameras=(SMALL_CAMERA, dataclasses.replace(SMALL_CAMERA, position_m=(0.05, -0.06, 0.0))),
    measurement=sim.MeasurementOptions(
        frame_rate_hz=2.0, keypoint_sigma_px=0.0, clutter_share=0.0, identity_swap_share=0.0
    ),
    calibration=sim.CalibrationOptions(focal_sigma_px=3.0, camera_rotation_sigma_deg=1.0),
    images=sim.ImageOptions(
        render=True, blur_samples=1, noise_sigma=0.0, gain_swing=0.0, vignette=0.0
    ),
    sessions=(sim.SessionOptions(kind="loop", duration_s=2.0, turns=0.05),),
)


@cache
def data() -> SimulatedData:
    return simulate(STEREO)


@cache
def scene() -> Scene:
    world = data().world
    options = sim.ImageOptions(texel_m=0.01)
    return make_scene(world.bounds, world.boxes, options, np.random.default_rng(0))


@cache
def painted() -> shading_kernels.PaintedBoxes:
    return painted_boxes(scene())


def _imager(row: int, **changes: float) -> Imager:
    session = data().recordings[0]
    T_I_C = session.device.true_rig.T_B_C[row]
    options = dataclasses.replace(STEREO.images, **changes)

    def at_time(time_s: np.ndarray) -> np.ndarray:
        return se3.compose(session.recording.spline.evaluate(time_s).T_G_I, T_I_C)

    camera, brightness = session.device.true_rig.cameras[row], Brightness(swing=options.gain_swing)
    return Imager.of(painted(), camera, options, 0.0, at_time, brightness)


def _image(row: int, time_s: float = 1.0, **changes: float) -> tuple[np.ndarray, np.ndarray]:
    return _imager(row, **changes).image(time_s, np.random.default_rng(0))


@pytest.mark.parametrize("row", [0, 1])
def test_depth_is_that_of_the_landmarks(row: int) -> None:
    truth, session = data().truth, data().recordings[0]
    found = session.recording.keypoints
    frame = 2
    own = found.frame == 2 * frame + row
    time_s = float(session.recording.frame_s[frame])
    _, depth = _image(row, time_s)
    T_G_C = se3.compose(truth.T_G_I[frame], session.device.true_rig.T_B_C[row])
    p_C = se3.transform(se3.inverse(T_G_C), truth.point_G[found.point[own]])
    uv = np.round(found.uv_true_px[own]).astype(int)
    assert len(uv) > 80
    ratio = depth[uv[:, 1], uv[:, 0]] / p_C[:, 2]
    # half a pixel away the surface is a little nearer or farther, or there is an edge
    assert np.median(np.abs(ratio - 1.0)) < 0.005
    assert np.mean(np.abs(ratio - 1.0) < 0.03) > 0.95


def test_both_images_show_the_same_surfaces() -> None:
    left, depth = _image(0)
    right, right_depth = _image(1)
    session = data().recordings[0]
    T_I_C = session.device.true_rig.T_B_C
    rays = pixel_rays(session.device.true_rig.cameras[0])
    v, u = (index.ravel() for index in np.mgrid[20:220:3, 20:350:3])
    p_L = np.concatenate([rays[v, u], np.ones((len(u), 1))], axis=1) * depth[v, u, None]
    p_R = se3.transform(se3.relative(T_I_C[1], T_I_C[0]), p_L)
    uv = pixels_of(session.device.true_rig.cameras[1], p_R)
    inside = np.all((uv > 2) & (uv < [372, 236]), axis=1)
    uv = uv[inside].astype(np.float32)
    there = cv2.remap(right.astype(np.float32), uv[:, :1], uv[:, 1:], cv2.INTER_LINEAR)[:, 0]
    far = cv2.remap(right_depth, uv[:, :1], uv[:, 1:], cv2.INTER_NEAREST)[:, 0]
    # what one camera sees and the other does not lies at another depth
    visible = np.abs(far / p_R[inside, 2] - 1.0) < 0.02
    assert visible.mean() > 0.8
    difference = np.abs(there - left[v, u][inside])[visible]
    assert np.median(difference) < 3.0
    assert np.corrcoef(there[visible], left[v, u][inside][visible])[0, 1] > 0.95


def test_exposure_blur_vignette_and_noise() -> None:
    plain = _image(0)[0].astype(float)
    dark = _image(0, vignette=0.5)[0].astype(float)
    assert dark[:20, :20].mean() < 0.6 * plain[:20, :20].mean()
    assert dark[110:130, 178:198].mean() == pytest.approx(plain[110:130, 178:198].mean(), rel=0.02)
    noisy = _image(0, noise_sigma=4.0)[0].astype(float)
    usable = (plain > 20) & (plain < 235)
    assert np.std((noisy - plain)[usable]) == pytest.approx(4.0, rel=0.03)
    bright = _image(0, time_s=1.75, gain_swing=0.2)[0].astype(float)
    assert bright.mean() == pytest.approx(1.2 * _image(0, time_s=1.75)[0].mean(), rel=0.03)
    blurred = _image(0, blur_samples=5, exposure_s=0.05)[0].astype(float)
    sharpness = [np.abs(np.diff(image, axis=1)).mean() for image in (plain, blurred)]
    assert sharpness[1] < 0.9 * sharpness[0]


def test_mesh_has_its_normals_in_the_free_space(tmp_path: Path) -> None:
    surfaces = scene().surfaces
    write_mesh(surfaces, tmp_path / "mesh.ply")
    content = (tmp_path / "mesh.ply").read_bytes()
    header, body = content.split(b"end_header\n", 1)
    corners = 4 * len(surfaces.normal)
    assert f"element vertex {corners}".encode() in header
    points = np.frombuffer(body, "<f4", 3 * corners).reshape(-1, 3).astype(float)
    faces = np.frombuffer(body[12 * corners :], [("count", "u1"), ("corner", "<i4", 3)])
    assert np.all(faces["count"] == 3)
    a, b, c = points[faces["corner"]].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    wanted = np.tile(surfaces.normal, (2, 1))
    large = np.linalg.norm(normal, axis=1) > 1e-3
    normal = normal[large] / np.linalg.norm(normal[large], axis=1)[:, None]
    np.testing.assert_allclose(np.sum(normal * wanted[large], axis=1), 1.0, atol=1e-4)


def test_the_command_writes_raw_data_when_asked(tmp_path: Path) -> None:
    scenario = tmp_path / "tiny.yaml"
    scenario.write_text(
        "world: {landmarks_per_room: 500}\nmeasurement: {frame_rate_hz: 2}\n"
        "sessions: [{duration_s: 2, turns: 0.1}]\n"
    )
    session = Session()
    plain = session.run("simulate", scenario=str(scenario), map_folder=tmp_path / "a")
    assert plain.raw_data == ()
    assert not (tmp_path / "a" / "raw").exists()
    report = session.run(
        "simulate", scenario=str(scenario), map_folder=tmp_path / "b", raw_data=True
    )
    assert (report.raw_data[0] / "mav0" / "imu0" / "data.csv").is_file()
    # this scenario renders no images
    assert not (report.raw_data[0] / "mav0" / "cam0" / "data").exists()
