"""Every layer holds what the map holds, where the map has it."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import UserError
from maplab_py.geometry import se3
from maplab_py.interop.trajectories import Trajectory
from maplab_py.sensors import Distortion, Projection
from maplab_py.sensors.camera import CAMERA_MODELS
from maplab_py.sensors.projection import project
from maplab_py.storage.mission_names import named
from maplab_py.storage.resources.new import NewResources
from maplab_py.viewer import colours
from maplab_py.viewer.building import Subject, build_scene
from maplab_py.viewer.display.selection import with_keypoints
from maplab_py.viewer.drawing import make_drawing
from maplab_py.viewer.layers.cameras import frustum_points
from maplab_py.viewer.layers.clouds import Cloud
from maplab_py.viewer.layers.landmarks import landmark_colours
from maplab_py.viewer.layers.references import MarkedSegments
from maplab_py.viewer.options import COLOURINGS, VisualizationOptions
from maplab_py.viewer.resource_clouds import VertexImages
from maplab_py.viewer.scene import Axes, Mesh, Points, Scene, Segments
from maplab_py.vimap import VIMap
from maplab_py.vimap.ids import to_hex_list
from maplab_py.vimap.merge import merge_maps
from maplab_py.vimap.selection import keep_rows
from tests.support.scene import make_camera
from tests.vimap.builders import walk_map


@pytest.fixture(scope="module")
def two_missions() -> VIMap:
    vi_map = merge_maps(walk_map(seed=1), walk_map(vertices=9, seed=2, first_ns=10**10))[0]
    quality = np.array(vi_map.landmarks.quality)
    quality[::7] = 1
    edges = vi_map.loop_closure_edges
    return vi_map.replace(
        landmarks=vi_map.landmarks.replace(quality=quality),
        loop_closure_edges=edges.replace(switch_variable=np.array([1.0, 0.0, 0.5, 1.0])),
    )


def _scene(vi_map: VIMap, **changes) -> Scene:
    options = VisualizationOptions(**changes.pop("options", {}))
    return build_scene(Subject(vi_map, "test", options, **changes))


def _points(scene: Scene, layer: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    parts = [part for part in scene.layer(layer).parts.values() if isinstance(part, Points)]
    return tuple(np.concatenate([getattr(p, n) for p in parts]) for n in ("p", "colours", "rows"))


def _segments(scene: Scene, layer: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    parts = [part for part in scene.layer(layer).parts.values() if isinstance(part, Segments)]
    return tuple(
        np.concatenate([getattr(p, n) for p in parts]) for n in ("ends", "colours", "rows")
    )


def test_vertices(two_missions: VIMap) -> None:
    scene = _scene(two_missions)
    p, colour, rows = _points(scene, "vertices")
    assert sorted(rows) == list(range(21))
    assert scene.layer("vertices").total == 21
    np.testing.assert_allclose(p, two_missions.T_G_I[rows, 4:], atol=1e-5)
    expected = colours.mission_colours(2)[two_missions.vertices.mission[rows]]
    np.testing.assert_array_equal(colour, expected)


def test_trajectories_join_the_vertices_of_one_mission(two_missions: VIMap) -> None:
    scene = _scene(two_missions)
    ends, _, rows = _segments(scene, "trajectories")
    assert sorted(rows) == [*range(11), *range(12, 20)]
    p = two_missions.T_G_I[:, 4:]
    np.testing.assert_allclose(ends, np.stack([p[rows], p[rows + 1]], axis=1), atol=1e-5)
    assert list(scene.layer("trajectories").parts) == to_hex_list(two_missions.missions.id)


def test_ends_of_paths_are_marked(two_missions: VIMap) -> None:
    scene = _scene(two_missions)
    parts = scene.layer("path_ends").parts
    ids = to_hex_list(two_missions.missions.id)
    assert list(parts) == ids
    for mission_id, rows in zip(ids, ([0, 11], [12, 20]), strict=True):
        dots = parts[mission_id]
        assert isinstance(dots, Points)
        np.testing.assert_array_equal(dots.rows, rows)
        np.testing.assert_allclose(dots.p, two_missions.T_G_I[rows, 4:], atol=1e-5)
        assert dots.labels == (f"start {mission_id[:8]}", f"end {mission_id[:8]}")
    with_names = _scene(named(two_missions, ["monday", "tuesday"]))
    assert [mission.name for mission in with_names.missions] == ["monday", "tuesday"]
    labels = [part.labels for part in with_names.layer("path_ends").parts.values()]
    assert labels == [("start monday", "end monday"), ("start tuesday", "end tuesday")]
    closed = np.array(walk_map().vertices.T_M_I)
    closed[-1] = closed[0]
    vi_map = walk_map()
    loop = vi_map.replace(vertices=vi_map.vertices.replace(T_M_I=closed))
    (dots,) = _scene(loop).layer("path_ends").parts.values()
    assert isinstance(dots, Points)
    assert dots.labels == ("start and end",)


def test_landmarks_good_and_bad(two_missions: VIMap) -> None:
    scene = _scene(two_missions)
    good, _, good_rows = _points(scene, "landmarks")
    bad, _, bad_rows = _points(scene, "bad_landmarks")
    is_bad = two_missions.landmarks.quality == 1
    np.testing.assert_array_equal(np.sort(bad_rows), np.flatnonzero(is_bad))
    np.testing.assert_array_equal(np.sort(good_rows), np.flatnonzero(~is_bad))
    np.testing.assert_allclose(good, two_missions.p_G[good_rows], atol=1e-5)
    np.testing.assert_allclose(bad, two_missions.p_G[bad_rows], atol=1e-5)
    assert scene.layer("landmarks").is_visible
    assert not scene.layer("bad_landmarks").is_visible
    shown = _scene(two_missions, options={"check_landmark_constrained": False})
    assert shown.layer("bad_landmarks").is_visible


def test_edges(two_missions: VIMap) -> None:
    scene = _scene(two_missions)
    p = two_missions.T_G_I[:, 4:]
    for layer, table in (
        ("imu_edges", two_missions.imu_edges),
        ("odometry_edges", two_missions.transformation_edges),
    ):
        ends, _, rows = _segments(scene, layer)
        assert scene.layer(layer).total == len(table) == len(rows) == 19
        expected = np.stack([p[table.from_vertex[rows]], p[table.to_vertex[rows]]], axis=1)
        np.testing.assert_allclose(ends, expected, atol=1e-5)


def test_loop_closures_have_the_colour_of_their_switch(two_missions: VIMap) -> None:
    scene = _scene(two_missions)
    edges = two_missions.loop_closure_edges
    ends, colour, rows = _segments(scene, "loop_closures")
    np.testing.assert_array_equal(rows, [0, 1, 2, 3])
    p = two_missions.T_G_I[:, 4:]
    np.testing.assert_allclose(ends[:, 0], p[edges.from_vertex], atol=1e-5)
    np.testing.assert_allclose(ends[:, 1], p[edges.to_vertex], atol=1e-5)
    np.testing.assert_array_equal(colour[0], colours.TRUST[-1])
    np.testing.assert_array_equal(colour[1], colours.TRUST[0])
    np.testing.assert_array_equal(colour[2], colours.TRUST[1])


def test_base_frames_and_absolute_poses(two_missions: VIMap) -> None:
    scene = _scene(two_missions)
    axes = list(scene.layer("base_frames").parts.values())
    assert [isinstance(part, Axes) for part in axes] == [True, True]
    T = np.concatenate([part.T for part in axes if isinstance(part, Axes)])
    np.testing.assert_allclose(T, two_missions.T_G_M)
    ends, _, rows = _segments(scene, "absolute_poses")
    assert scene.layer("absolute_poses").total == 4
    np.testing.assert_allclose(ends[:, 0], two_missions.absolute_poses.T_G_S[rows, 4:], atol=1e-5)


@pytest.mark.parametrize("model", CAMERA_MODELS, ids=lambda m: "-".join(x.value for x in m))
def test_corners_of_every_camera_are_seen_in_the_corners(
    model: tuple[Projection, Distortion],
) -> None:
    camera = make_camera(*model)
    centre, *corners = frustum_points(camera, 0.5)
    np.testing.assert_array_equal(centre, 0.0)
    uv, visible = project(camera, np.array(corners))
    assert visible.all()
    off = (uv - [320.0, 240.0]) / [320.0, 240.0]
    np.testing.assert_array_equal(np.sign(off), [[-1, -1], [1, -1], [1, 1], [-1, 1]])
    assert np.abs(off).min() > 0.15


def test_frusta_begin_at_the_cameras(two_missions: VIMap) -> None:
    scene = _scene(two_missions, options={"frustum_every_nth": 2})
    ends, _, rows = _segments(scene, "frusta")
    assert sorted(set(rows)) == [*range(0, 12, 2), *range(12, 21, 2)]
    assert len(rows) == 8 * 11
    T_I_C = np.array([0.0, 0.0, 0.0, 1.0, 0.05, 0.0, 0.0])
    centre = se3.compose(two_missions.T_G_I[rows], T_I_C)[:, 4:]
    starts_at_centre = np.arange(len(rows)) % 8 < 4
    np.testing.assert_allclose(ends[starts_at_centre, 0], centre[starts_at_centre], atol=1e-5)
    forward = se3.transform(se3.compose(two_missions.T_G_I[rows], T_I_C), [0.0, 0.0, 1.0]) - centre
    depth = np.einsum("ij,ij->i", ends[:, 1] - centre, forward)
    assert (depth > 0.0).all()


def test_observers_of_landmarks(two_missions: VIMap) -> None:
    scene = _scene(two_missions, shows_observers=True)
    ends, _, rows = _segments(scene, "observers")
    good = two_missions.landmarks.quality != 1
    counts = np.diff(two_missions.observation_start)
    assert scene.layer("observers").total == counts[good].sum() == len(rows)
    np.testing.assert_allclose(ends[:, 1], two_missions.p_G[rows], atol=1e-5)


@pytest.mark.parametrize("colouring", COLOURINGS)
def test_every_colouring_colours_every_landmark(two_missions: VIMap, colouring: str) -> None:
    options = VisualizationOptions().with_colouring(colouring)
    assert options.landmark_colouring == colouring
    scene = build_scene(Subject(two_missions, "test", options))
    _, colour, rows = _points(scene, "landmarks")
    assert len(colour) == len(rows) == (two_missions.landmarks.quality != 1).sum()
    if colouring == "grey":
        assert (colour == 150).all()
    if colouring == "mission":
        home = two_missions.vertices.mission[two_missions.landmarks.vertex[rows]]
        assert len(np.unique(colour[home == 0], axis=0)) == 1
    if colouring == "quality":
        assert (colour == colours.QUALITY[2]).all()
    assert bool(scene.layer("landmarks").legend) == (colouring not in ("grey", "mission"))


def test_landmarks_have_the_colours_of_their_pixels(tmp_path: Path) -> None:
    vi_map = walk_map(vertices=6)
    new = NewResources(tmp_path)
    columns = np.tile(np.arange(300) % 251, (480, 1)).astype(np.uint8)  # a part of the image
    frames = vi_map.frame_start[[1, 4]].tolist()
    vi_map = new.attached(vi_map, [new.add_image(columns) for _ in frames], frames)
    images = VertexImages(vi_map, Path())
    options = VisualizationOptions().with_colouring("pixels")
    _, colour, rows = _points(
        build_scene(Subject(vi_map, "test", options, images=images)), "landmarks"
    )
    of_frame = np.isin(vi_map.keypoint_frame, frames) & (vi_map.keypoints.landmark >= 0)
    of_frame &= vi_map.keypoints.uv_px[:, 0] < 300.0
    seen = np.unique(vi_map.keypoints.landmark[of_frame])
    is_seen = np.isin(rows, seen)
    assert 0 < np.count_nonzero(is_seen) < len(rows)
    assert (colour[~is_seen] == colours.REFERENCE).all()
    first = np.flatnonzero(of_frame)
    u_of = {int(vi_map.keypoints.landmark[k]): vi_map.keypoints.uv_px[k, 0] for k in first[::-1]}
    expected = np.array([int(u_of[row]) % 251 for row in rows[is_seen].tolist()])
    assert (colour[is_seen] == np.clip(expected, 40, 215)[:, None]).all()

    kept = keep_rows(vi_map, vertices=np.arange(3, 6))  # the images keep their vertices
    moved = images.of_map(kept)
    assert images.image(4) is not None
    assert [moved.image(row) is not None for row in range(3)] == [False, True, False]
    black = np.zeros((480, 640, 3), dtype=np.uint8)
    picture, words = with_keypoints(vi_map, black, frames[0])
    count = np.count_nonzero(vi_map.keypoints.landmark[vi_map.keypoint_frame == frames[0]] >= 0)
    assert f"{count} tracked keypoints" in words
    drawn = picture[picture.any(axis=2)]
    assert len(drawn) > 10 * count / 2
    assert (drawn == colours.TRUST[-1]).all()  # they are where the map has them


def test_height_colours_rise_and_repeat() -> None:
    vi_map = walk_map()
    z = vi_map.p_G[:, 2]
    options = {"color_landmarks_by_height": True, "color_by_height_period_m": 1.0}
    _, colour, rows = _points(_scene(vi_map, options=options), "landmarks")
    np.testing.assert_array_equal(colour, colours.ramp(np.mod(z[rows], 1.0), colours.SEQUENTIAL))


def test_a_single_mission_is_coloured_by_height(two_missions: VIMap) -> None:
    first, second = to_hex_list(two_missions.missions.id)
    only = {"color_landmarks_by_height": True, "color_only_missions": f"{second[:8]}, abcdabcd"}
    scene = _scene(two_missions, options=only)
    by_mission, by_height = (
        _scene(two_missions, options=options).layer("landmarks").parts
        for options in ({}, {"color_landmarks_by_height": True})
    )
    parts = scene.layer("landmarks").parts
    np.testing.assert_array_equal(parts[first].colours, by_mission[first].colours)
    assert (parts[second].colours != by_mission[second].colours).any()
    order = np.argsort(parts[second].p[:, 2])
    assert (parts[second].colours[order[-1]] == colours.SEQUENTIAL[-1]).all()
    assert scene.notes == ("--vis_color_only_missions: no mission has the id abcdabcd",)
    assert by_height.keys() == parts.keys()


def test_observation_counts_are_on_a_scale_from_one() -> None:
    vi_map = walk_map()
    options = {"color_landmarks_by_number_of_observations": True, "landmarks_max_observers": 5}
    _, colour, rows = _points(_scene(vi_map, options=options), "landmarks")
    counts = np.diff(vi_map.observation_start)[rows]
    np.testing.assert_array_equal(colour, colours.ramp((counts - 1) / 4.0, colours.SEQUENTIAL))


def test_flags_leave_landmarks_out() -> None:
    vi_map = walk_map()
    counts = np.diff(vi_map.observation_start)
    few = _scene(vi_map, options={"landmarks_min_observers": 8})
    assert few.layer("landmarks").total == (counts >= 8).sum() < len(counts)
    many = {"landmarks_min_number_of_observer_missions": 2}
    assert "landmarks" not in _scene(vi_map, options=many).names
    assert "landmarks" not in _scene(vi_map, options={"show_only_landmark_type": "9"}).names


def test_every_landmark_that_is_left_out_has_its_reason(two_missions: VIMap) -> None:
    few = {"landmarks_min_observers": 10, "max_points": 10}
    scene = _scene(two_missions, options=few, other=two_missions)
    bad = int(np.count_nonzero(two_missions.landmarks.quality == 1))
    total = len(two_missions.landmarks)
    counts = np.diff(two_missions.observation_start)
    unseen = int(np.count_nonzero((counts < 10) & (two_missions.landmarks.quality != 1)))
    notes = {note.partition(":")[0]: note for note in scene.notes}
    assert notes["Landmarks"] == (
        f"Landmarks: 10 of {total - bad} are drawn (left out: {unseen} by "
        f"--vis_landmarks_min_observers, {total - bad - unseen - 10} by --vis_max_points)"
    )
    assert notes["Reference landmarks"] == (
        f"Reference landmarks: 10 of {total} are drawn (left out: {bad} of bad quality, "
        f"{total - bad - 10} by --vis_max_points)"
    )
    everything = _scene(two_missions, other=two_missions).notes
    assert everything == (
        "in grey: before",
        f"Reference landmarks: {total - bad} of {total} are drawn (left out: {bad} of bad quality)",
    )


def test_missions_can_be_drawn_apart(two_missions: VIMap) -> None:
    apart = {"spatially_distribute_missions_meters": 20.0, "offset_z_m": 3.0}
    p, _, rows = _points(_scene(two_missions, options=apart), "vertices")
    moved = p - two_missions.T_G_I[rows, 4:]
    np.testing.assert_allclose(moved[:, 0], 20.0 * two_missions.vertices.mission[rows], atol=1e-5)
    np.testing.assert_allclose(moved[:, 2], 3.0, atol=1e-5)


def test_a_map_far_from_the_origin_keeps_its_millimetres() -> None:
    vi_map = walk_map()
    T_G_M = np.array(vi_map.baseframes.T_G_M)
    T_G_M[:, 4:] += [465_000.0, 5_247_000.0, 400.0]
    far = vi_map.replace(baseframes=vi_map.baseframes.replace(T_G_M=T_G_M))
    scene = _scene(far)
    p, _, rows = _points(scene, "vertices")
    assert np.abs(scene.origin_G).max() > 1e6
    np.testing.assert_allclose(
        p.astype(np.float64) + scene.origin_G, far.T_G_I[rows, 4:], atol=1e-4
    )


def test_points_that_are_not_finite_are_left_out() -> None:
    vi_map = walk_map()
    p_I = np.array(vi_map.landmarks.p_I)
    p_I[3] = np.nan
    p_I[5, 0] = np.nan
    broken = vi_map.replace(landmarks=vi_map.landmarks.replace(p_I=p_I))
    _, _, rows = _points(_scene(broken), "landmarks")
    assert set(range(60)) - set(rows) == {3, 5}


def test_extent_leaves_out_outliers() -> None:
    vi_map = walk_map(landmarks=400)
    p_I = np.array(vi_map.landmarks.p_I)
    p_I[:10] *= 1e4
    wild = vi_map.replace(landmarks=vi_map.landmarks.replace(p_I=p_I))
    radius = _scene(vi_map).extent.radius_m
    assert _scene(wild).extent.radius_m == pytest.approx(radius, rel=0.1)


def test_a_device_that_stands_sees_its_room() -> None:
    vi_map = walk_map(landmarks=400)
    T = np.array(vi_map.vertices.T_M_I)
    T[:, 4:] *= 1e-3
    standing = vi_map.replace(vertices=vi_map.vertices.replace(T_M_I=T))
    extent = _scene(standing).extent
    low, high = np.percentile(standing.p_G, [10.0, 90.0], axis=0)
    assert (extent.outline.min(axis=0) <= low).all()
    assert (extent.outline.max(axis=0) >= high).all()
    dark = standing.replace(landmarks=vi_map.landmarks.replace(p_I=np.full((400, 3), np.nan)))
    assert _scene(dark).extent.radius_m < 0.05


def test_comparison_shows_by_how_much_vertices_moved(two_missions: VIMap) -> None:
    T = np.array(two_missions.vertices.T_M_I)
    T[:, 6] += 0.5
    T[12:, 6] += 1.0
    moved = two_missions.replace(vertices=two_missions.vertices.replace(T_M_I=T))
    scene = _scene(moved, other=two_missions)
    ends, colour, rows = _segments(scene, "displacements")
    assert sorted(rows) == list(range(21))
    lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    np.testing.assert_allclose(lengths, np.where(rows < 12, 0.5, 1.5), atol=1e-5)
    np.testing.assert_array_equal(colour[rows >= 12], np.tile(colours.HEAT[-1], (9, 1)))
    p = scene.layer("reference_trajectories").parts[""]
    assert isinstance(p, Segments)
    np.testing.assert_allclose(p.ends[0, 0], two_missions.T_G_I[0, 4:], atol=1e-5)
    beside = _scene(moved, other=two_missions, arrangement="beside")
    assert "displacements" not in beside.names


def test_ground_truth_is_laid_on_the_map() -> None:
    vi_map = walk_map()
    T_W_G = se3.make([0.0, 0.0, np.sin(0.3), np.cos(0.3)], [5.0, -3.0, 2.0])
    T_W_I = se3.compose(T_W_G, vi_map.T_G_I)
    truth = Trajectory(vi_map.vertices.timestamp_ns, T_W_I, source="truth.csv")
    scene = _scene(vi_map, truth=truth)
    ends, _, rows = _segments(scene, "errors")
    assert len(rows) == len(vi_map.vertices)
    np.testing.assert_allclose(ends[:, 0], ends[:, 1], atol=1e-5)
    path, _, _ = _segments(scene, "ground_truth")
    np.testing.assert_allclose(path[:, 0], vi_map.T_G_I[:-1, 4:], atol=1e-5)
    late = dataclasses.replace(truth, times_ns=truth.times_ns + 10**12)
    with pytest.raises(UserError, match=r"truth.csv: only 0 vertices .* clocks"):
        _scene(vi_map, truth=late)


def test_marked_segments_follow_the_trajectory() -> None:
    vi_map = walk_map()
    marked = MarkedSegments(np.array([1, 6]), np.array([4, 8]), np.array([1.0, 9.0]))
    scene = _scene(vi_map, segments=marked)
    ends, colour, rows = _segments(scene, "marked_segments")
    assert list(rows) == [0, 0, 0, 1, 1]
    p = vi_map.T_G_I[:, 4:]
    np.testing.assert_allclose(ends[:, 0], p[[1, 2, 3, 6, 7]], atol=1e-5)
    np.testing.assert_allclose(ends[:, 1], p[[2, 3, 4, 7, 8]], atol=1e-5)
    assert (colour[0] == colours.HEAT[0]).all()
    assert (colour[-1] == colours.HEAT[-1]).all()


def test_clouds_and_meshes() -> None:
    rng = np.random.default_rng(0)
    p = rng.normal(size=(500, 3))
    own = rng.integers(0, 255, (500, 3)).astype(np.uint8)
    faces = np.array([[0, 1, 2], [2, 3, 4]], dtype=np.int32)
    clouds = (Cloud("cloud", p, own), Cloud("surface", p[:5], faces=faces))
    scene = _scene(walk_map(), clouds=clouds, options={"max_points": 100})
    drawn, colour, rows = _points(scene, "cloud_0")
    assert scene.layer("cloud_0").total == 500
    assert len(rows) == 100
    np.testing.assert_allclose(drawn, p[rows], atol=1e-6)
    np.testing.assert_array_equal(colour, own[rows])
    assert scene.notes == ("cloud: 100 of 500 are drawn (left out: 400 by --vis_max_points)",)
    mesh = scene.layer("mesh_0").parts[""]
    assert isinstance(mesh, Mesh)
    np.testing.assert_array_equal(mesh.faces, faces)
    assert mesh.colours.shape == (3,)
    coloured = _scene(walk_map(), clouds=(Cloud("surface", p[:5], own[:5], faces=faces),))
    mesh = coloured.layer("mesh_0").parts[""]
    assert isinstance(mesh, Mesh)
    np.testing.assert_array_equal(mesh.colours, own[:5])


def test_an_empty_map_is_refused() -> None:
    with pytest.raises(UserError, match="'empty' has no vertices"):
        build_scene(Subject(VIMap(), "empty"))


def test_landmarks_have_the_colour_of_the_camera_that_saw_them_first(
    two_missions: VIMap,
) -> None:
    frames = two_missions.frames
    camera_index = (np.arange(len(frames)) % 3).astype(frames.camera_index.dtype)
    vi_map = two_missions.replace(frames=frames.replace(camera_index=camera_index))
    options = VisualizationOptions(color_landmarks_by_first_observer_frame=True)
    colour, legend = landmark_colours(make_drawing(vi_map, options))
    camera = camera_index[vi_map.keypoint_frame]
    palette = colours.mission_colours(3)
    for row, shown in enumerate(colour):
        observing = np.flatnonzero(vi_map.keypoints.landmark == row)
        assert tuple(shown) == tuple(palette[camera[observing[0]]])
    assert len(np.unique(colour, axis=0)) > 1
    assert {entry.text for entry in legend} <= {"camera 0", "camera 1", "camera 2"}


def test_landmarks_that_nothing_observes_are_grey_by_camera() -> None:
    vi_map = walk_map()
    keypoints = vi_map.keypoints
    landmark = np.where(keypoints.landmark == 5, -1, keypoints.landmark)
    vi_map = vi_map.replace(keypoints=keypoints.replace(landmark=landmark))
    options = VisualizationOptions(color_landmarks_by_first_observer_frame=True)
    colour, legend = landmark_colours(make_drawing(vi_map, options))
    assert tuple(colour[5]) == tuple(colours.REFERENCE)
    assert [entry.text for entry in legend] == ["camera 0", "not observed"]


def test_landmarks_are_separated_by_the_camera_that_saw_them_first(two_missions: VIMap) -> None:
    frames = two_missions.frames
    camera_index = (np.arange(len(frames)) % 3).astype(frames.camera_index.dtype)
    vi_map = two_missions.replace(frames=frames.replace(camera_index=camera_index))
    options = VisualizationOptions(offset_landmarks_by_first_observer_frame_m=5.0)
    shift = make_drawing(vi_map, options).p_landmarks - vi_map.p_G
    assert not shift[:, 1:].any()
    camera = camera_index[vi_map.keypoint_frame]
    for row, x in enumerate(shift[:, 0]):
        observing = np.flatnonzero(vi_map.keypoints.landmark == row)
        assert x == pytest.approx(5.0 * camera[observing[0]])
    assert len(np.unique(shift[:, 0].round())) > 1
