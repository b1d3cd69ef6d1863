"""Rectification of every camera model, and depth of rendered stereo images against the truth."""

from pathlib import Path
from typing import Any

import cv2
import numba
import numpy as np
import pytest

from maplab_py.algorithms.dense import depth_matcher, rectification
from maplab_py.algorithms.dense.clouds import convert_depth_maps, depth_of_cloud
from maplab_py.algorithms.dense.options import BmOptions, SgbmOptions, StereoOptions
from maplab_py.algorithms.dense.pinhole import ImageMap, undistorted
from maplab_py.algorithms.dense.reconstruction import StereoSettings, reconstruct_stereo
from maplab_py.algorithms.dense.resources import FrameResources
from maplab_py.array_types import F64
from maplab_py.errors import MapError, UserError
from maplab_py.geometry import se3, so3
from maplab_py.interop.ply import parse_ply
from maplab_py.interop.resources.images import ImageImportOptions, import_images
from maplab_py.sensors import Camera, CameraRig, Distortion, Projection
from maplab_py.sensors.camera import CAMERA_MODELS
from maplab_py.sensors.projection import back_project, is_inside_image, project
from maplab_py.storage.resources.new import NewResources
from maplab_py.storage.resources.store import ResourceStore
from maplab_py.vimap import VIMap, resources_of, without_resources
from tests.support.stereo_room import StereoRoom

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


def pairs_of(rig: CameraRig) -> tuple[list[rectification.StereoPair], list[str]]:
    return rectification.stereo_pairs(rig, min_baseline_m=0.02, max_angle_rad=0.785)


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


# the regions that count as speckles are areas in pixels: a quarter of the default's
SGBM = SgbmOptions(speckle_window_size=125)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> StereoRoom:
    return StereoRoom.simulated(tmp_path_factory.mktemp("stereo"))


@pytest.fixture(scope="module")
def with_images(room: StereoRoom) -> VIMap:
    return import_images(room.true_map, 0, room.recording)[0]


def settings(**changes: Any) -> StereoSettings:
    return StereoSettings(StereoOptions(**changes), SGBM)


def errors(room: StereoRoom, vi_map: VIMap) -> tuple[F64, F64]:
    """Return the relative errors and the errors of disparity [px] of all pixels with depth."""
    resources = FrameResources(vi_map, Path())
    relative, disparity = [], []
    for row in np.flatnonzero(resources_of(vi_map, (8,))).tolist():
        depth = resources.depth(row)
        stamp = vi_map.frames.timestamp_ns[vi_map.resources.owner[row]]
        truth = cv2.imread(str(room.depth() / f"{stamp}.png"), cv2.IMREAD_UNCHANGED) * 1e-3
        known = (depth > 0) & (truth > 0)
        relative.append(np.abs(depth / np.maximum(truth, 1e-3) - 1.0)[known])
        focal_baseline = 168.0 * 0.11
        difference = focal_baseline / depth[known] - focal_baseline / truth[known]
        disparity.append(np.abs(difference))
    return np.concatenate(relative), np.concatenate(disparity)


def test_depth_is_right_and_neighbours_remove_errors(room: StereoRoom, with_images: VIMap) -> None:
    raw, raw_report = reconstruct_stereo(with_images, Path(), None, settings(multi_view=False))
    checked, report = reconstruct_stereo(with_images, Path(), None, settings())
    assert report.resources == len(with_images.vertices)
    assert raw_report.pairs[0].matched_share > 0.9
    assert 0.6 < report.pairs[0].kept_share < report.pairs[0].matched_share
    raw_relative, raw_disparity = errors(room, raw)
    relative, disparity = errors(room, checked)
    assert np.median(raw_relative) < 0.03
    assert np.median(relative) < 0.03
    assert np.mean(raw_disparity > 3.0) < 0.02
    assert np.mean(disparity > 3.0) < 0.5 * np.mean(raw_disparity > 3.0)


def test_threads_do_not_matter(with_images: VIMap) -> None:
    results = []
    before = numba.get_num_threads()
    for threads in (1, before):
        numba.set_num_threads(threads)
        results.append(reconstruct_stereo(with_images, Path(), None, part_settings())[0])
    numba.set_num_threads(before)
    new = [resources_of(vi_map, (8,)) for vi_map in results]
    ids = [vi_map.resources.id[rows] for vi_map, rows in zip(results, new, strict=True)]
    np.testing.assert_array_equal(*ids)


def part_settings(**changes: Any) -> StereoSettings:
    """Return settings for the first vertices only."""
    return settings(debug_reconstruction_end_fraction_of_trajectory=0.25, **changes)


def test_block_matching_works_and_the_check_removes_pixels(with_images: VIMap) -> None:
    shares = []
    for check in (False, True):
        options = part_settings(use_sgbm=False, depth_check=check, multi_view=False).stereo
        bm = BmOptions(speckle_window_size=125)
        report = reconstruct_stereo(with_images, Path(), None, StereoSettings(options, SGBM, bm))[1]
        shares.append(report.pairs[0].matched_share)
    assert 0.2 < shares[1] < shares[0]


def test_depth_exists_again_only_on_request(with_images: VIMap) -> None:
    once, _ = reconstruct_stereo(with_images, Path(), None, part_settings())
    with pytest.raises(UserError, match="--overwrite"):
        reconstruct_stereo(once, Path(), None, part_settings())
    again, _ = reconstruct_stereo(once, Path(), None, part_settings(), overwrite=True)
    np.testing.assert_array_equal(again.resources.id, once.resources.id)


def test_clouds_are_the_depth_maps_in_space(with_images: VIMap) -> None:
    options = part_settings(multi_view=False)
    depth_map, _ = reconstruct_stereo(with_images, Path(), None, options)
    clouds, report = reconstruct_stereo(with_images, Path(), None, options, output_type=17)
    assert report.resource_type == "color_point_cloud"
    converted, counts = convert_depth_maps(depth_map, Path())
    assert counts.clouds_with_colours == counts.depth_maps == report.resources
    row = int(np.flatnonzero(resources_of(depth_map, (8,)))[0])
    resources = FrameResources(depth_map, Path())
    depth = resources.depth(row)
    for vi_map, tolerance in ((clouds, 6e-4), (converted, 1e-5)):
        cloud_row = int(np.flatnonzero(resources_of(vi_map, (17,)))[0])
        cloud = parse_ply(ResourceStore(vi_map, Path()).load(cloud_row), "cloud")
        camera = resources.camera(int(depth_map.resources.owner[row]))
        again = depth_of_cloud(camera, cloud.p)
        np.testing.assert_allclose(again, depth, atol=tolerance)
        assert cloud.colours is not None
    once_more, counts = convert_depth_maps(converted, Path())
    assert once_more is converted
    assert counts.frames_with_cloud == counts.depth_maps


def test_near_scenes_are_matched_over_more_disparities() -> None:
    (pair,), _ = pairs_of(make_rig())
    width, focal_baseline = pair.pinhole.width_px, pair.pinhole.focal_px * pair.baseline_m
    options = StereoOptions(), SgbmOptions(), BmOptions()
    usual = depth_matcher.DepthMatcher(pair, *options)
    assert usual.disparities_px == (width // 8 + 15) & -16
    near_m = 0.6 * usual.nearest_m
    near = depth_matcher.DepthMatcher(pair, *options, near_m)
    assert near.nearest_m <= near_m < usual.nearest_m
    assert near.nearest_m == pytest.approx(focal_baseline / near.disparities_px)
    assert depth_matcher.DepthMatcher(pair, *options, 5.0).disparities_px == usual.disparities_px
    assert depth_matcher.DepthMatcher(pair, *options, 1e-6).disparities_px <= 0.4 * width + 16
    as_given = StereoOptions(adapt_params_to_image_size=False)
    assert depth_matcher.DepthMatcher(pair, as_given, *options[1:], near_m).disparities_px == 128


def test_bad_input_is_refused_in_one_line(room: StereoRoom, with_images: VIMap) -> None:
    with pytest.raises(UserError, match="import_images"):
        reconstruct_stereo(room.true_map, Path())
    with pytest.raises(UserError, match="wants 8 or 17"):
        reconstruct_stereo(with_images, Path(), output_type=9)
    with pytest.raises(UserError, match="no depth maps"):
        convert_depth_maps(with_images, Path())
    far = StereoSettings(StereoOptions(min_baseline=1.0), SGBM)
    with pytest.raises(UserError, match="--dense_stereo_min_baseline"):
        reconstruct_stereo(with_images, Path(), None, far)
    for sgbm, message in (
        (SgbmOptions(num_disparities=100), "multiple of 16"),
        (SgbmOptions(sad_window_size=4), "must be odd"),
        (SgbmOptions(p1=300), "p1 < --dense_stereo_sgbm_p2"),
    ):
        options = StereoOptions(adapt_params_to_image_size=False)
        with pytest.raises(UserError, match=message):
            reconstruct_stereo(with_images, Path(), None, StereoSettings(options, sgbm))


def test_images_of_another_size_are_refused(room: StereoRoom) -> None:
    vi_map = room.true_map
    new = NewResources()
    rows = [new.add_image(np.zeros((24, 32), dtype=np.uint8)) for _ in range(2)]
    with pytest.raises(MapError, match=r"32 x 24 pixels, the images of its camera 376 x 240"):
        reconstruct_stereo(new.attached(vi_map, rows, [0, 1]), Path())


def test_images_of_one_camera_are_no_stereo(room: StereoRoom, with_images: VIMap) -> None:
    right = with_images.frames.camera_index[with_images.resources.owner] == 1
    with pytest.raises(UserError, match="no vertex has images of a stereo pair"):
        reconstruct_stereo(without_resources(with_images, right), Path())
    some, report = import_images(room.true_map, 0, room.recording, ImageImportOptions(every_nth=4))
    _, stereo = reconstruct_stereo(some, Path(), None, settings())
    assert stereo.pairs[0].vertices == report.attached // 2
    assert stereo.pairs[0].without_images == len(some.vertices) - report.attached // 2
