"""Projection against OpenCV's and the estimator's, descriptors by view, and landmarks on surfaces."""

import dataclasses

import numpy as np
import pytest

from maplab_py.sensors import Camera, CameraRig, Distortion, Projection
from maplab_py.sensors.camera import CAMERA_MODELS
from maplab_py.sensors.projection import project
from maplab_py.simulation import scenario as sim
from maplab_py.simulation.cameras import field_of_view_radius, pixels_of
from maplab_py.simulation.detection import Detections, is_hidden
from maplab_py.simulation.scene import describe, make_appearance, make_session_appearance
from maplab_py.simulation.simulate import simulate
from maplab_py.simulation.truth import true_map
from maplab_py.simulation.world import make_world
from tests.simulation.small import docs_script, simulated
from tests.support.data import REPOSITORY, shared_data

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
        sim.CameraOptions(
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
        sim.Scenario(), sessions=(sim.SessionOptions(duration_s=2.0),), cameras=cameras
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


COUNT = 400


def _detections(view: list[float], distance: float) -> Detections:
    rows = np.arange(COUNT)
    direction = np.array(view) / np.linalg.norm(view)
    return Detections(
        frame=np.zeros(COUNT, dtype=np.int64),
        point=rows,
        track=rows,
        uv_true_px=np.zeros((COUNT, 2)),
        uv_px=np.zeros((COUNT, 2)),
        view_G=np.tile(direction, (COUNT, 1)),
        distance_m=np.full(COUNT, distance),
        octave=np.zeros(COUNT, dtype=np.int64),
    )


def _distance(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.median(np.bitwise_count(a ^ b).sum(axis=1)))


def test_distances_grow_with_view_scale_and_session() -> None:
    world = make_appearance(sim.AppearanceOptions(), np.arange(COUNT), np.random.default_rng(0))
    session = make_session_appearance(world, np.random.default_rng(1))
    other = make_session_appearance(world, np.random.default_rng(2))
    rng = np.random.default_rng(3)
    here = describe(session, _detections([0, 0, 1], 3.0), rng)
    again = describe(session, _detections([0, 0, 1], 3.0), rng)
    tilted = describe(session, _detections([1, 0, 1], 3.0), rng)
    far = describe(session, _detections([0, 0, 1], 9.0), rng)
    later = describe(other, _detections([0, 0, 1], 3.0), rng)
    bits = 8 * here.shape[1]
    assert here.shape == (COUNT, 48)
    same = _distance(here, again)
    assert 0.02 * bits < same < 0.15 * bits
    assert same < _distance(here, tilted) < 0.3 * bits
    assert same < _distance(here, far) < 0.3 * bits
    assert same < _distance(here, later) < 0.3 * bits
    assert 0.45 * bits < _distance(here, here[::-1]) < 0.55 * bits


def test_bits_are_correlated() -> None:
    world = make_appearance(sim.AppearanceOptions(), np.arange(COUNT), np.random.default_rng(0))
    session = make_session_appearance(world, np.random.default_rng(1))
    found = describe(session, _detections([0, 0, 1], 3.0), np.random.default_rng(3))
    bits = np.unpackbits(found, axis=1).astype(np.float64)
    correlation = np.corrcoef(bits.T)
    np.fill_diagonal(correlation, 0.0)
    # independent bits of 400 points would stay below 0.25
    assert np.abs(correlation).max() > 0.3


def test_share_that_vanishes() -> None:
    world = make_appearance(
        sim.AppearanceOptions(vanish_share=0.3), np.arange(5000), np.random.default_rng(0)
    )
    session = make_session_appearance(world, np.random.default_rng(1))
    assert abs(np.mean(session.is_there) - 0.7) < 0.03


def test_length_of_the_descriptor() -> None:
    options = sim.AppearanceOptions(descriptor_bytes=64)
    world = make_appearance(options, np.arange(COUNT), np.random.default_rng(0))
    session = make_session_appearance(world, np.random.default_rng(1))
    found = describe(session, _detections([0, 0, 1], 3.0), np.random.default_rng(3))
    assert found.shape == (COUNT, 64)
    assert found.dtype == np.uint8


def test_distances_are_those_of_recorded_maps() -> None:
    vi_map = simulated().maps[0]
    rows = vi_map.observations
    landmark = vi_map.keypoints.landmark[rows]
    point = simulated().truth.landmark_point[landmark]
    descriptor = vi_map.keypoints.descriptor[rows]
    next_same = landmark[1:] == landmark[:-1]
    shuffled = np.random.default_rng(0).permutation(len(rows))
    other = point[shuffled] != point
    same = np.bitwise_count(descriptor[1:] ^ descriptor[:-1]).sum(axis=1)[next_same]
    different = np.bitwise_count(descriptor[shuffled] ^ descriptor).sum(axis=1)[other]
    # measured on Tango and EuRoC maps: equal 8 28 51 82 140, different 107 132 178 220
    assert 40 < np.median(same) < 60
    assert 75 < np.percentile(same, 95) < 145
    assert 165 < np.median(different) < 190
    assert 110 < np.percentile(different, 1) < 140
    assert np.percentile(same, 99) > np.percentile(different, 1)


@pytest.mark.slow
def test_distances_share_their_histograms_with_those_of_recorded_maps() -> None:
    folders = [
        shared_data("maplab_maps/tango_handheld"),
        *sorted(shared_data("maplab_maps/euroc_v1_01").iterdir()),
    ]
    script = docs_script("compare_descriptors")
    recorded, simulated_bits = script.recorded_distances(folders), script.simulated_distances()
    for kind in ("same", "different"):
        common = script.overlap(
            script.histogram(recorded[kind]), script.histogram(simulated_bits[kind])
        )
        # the recorded maps share 0.88 and 0.90 with each other
        assert common > 0.88
    figure = (REPOSITORY / "docs/images/descriptor_distances.svg").read_text()
    assert figure == script.drawing(recorded, simulated_bits)


@pytest.mark.parametrize("rooms", [1, 3])
def test_landmarks_are_on_walls_or_furniture(rooms: int) -> None:
    options = sim.WorldOptions(rooms=rooms, landmarks_per_room=500)
    world = make_world(options, np.random.default_rng(0))
    size = np.array(options.room_size_m)
    local = world.p_G - np.array([size[0], 0, 0]) * np.round(world.p_G[:, :1] / size[0])
    on_wall = np.any(np.abs(np.abs(local - [0, 0, size[2] / 2]) - size / 2) < 1e-5, axis=1)
    low, high = world.boxes[:, 0], world.boxes[:, 1]
    inside = np.all((world.p_G[:, None] > low - 1e-5) & (world.p_G[:, None] < high + 1e-5), axis=2)
    assert np.all(on_wall | inside.any(axis=1))
    assert on_wall.any()
    assert not on_wall.all()
    np.testing.assert_allclose(np.linalg.norm(world.normal_G, axis=1), 1.0)
    np.testing.assert_allclose(world.bounds[1] - world.bounds[0], [rooms * size[0], *size[1:]])
    np.testing.assert_array_equal(world.look, np.arange(len(world.p_G)))


def test_wall_normals_look_inwards() -> None:
    world = make_world(sim.WorldOptions(furniture_per_room=0), np.random.default_rng(0))
    middle = np.array([0.0, 0.0, 1.75])
    assert np.all(np.sum((middle - world.p_G) * world.normal_G, axis=1) > 0.0)


def test_a_box_hides_what_is_behind_and_nothing_else() -> None:
    box = np.array([[[1.0, -1.0, -1.0], [2.0, 1.0, 1.0]]])
    eye = np.zeros((5, 3))
    points = np.array(
        [[3.0, 0, 0], [0.5, 0, 0], [3.0, 4.0, 0], [-3.0, 0, 0], [1.0 - 1e-6, 0.3, 0.3]]
    )
    np.testing.assert_array_equal(is_hidden(box, eye, points), [True, False, False, False, False])


def test_rooms_see_each_other_through_the_doorway_only() -> None:
    options = sim.WorldOptions(rooms=2, furniture_per_room=0)
    world = make_world(options, np.random.default_rng(0))
    eye = np.array([[2.0, 0.0, 1.5], [2.0, 0.0, 1.5]])
    points = np.array([[8.0, 0.0, 1.5], [8.0, 3.9, 1.5]])
    np.testing.assert_array_equal(is_hidden(world.boxes, eye, points), [False, True])
    at_door = np.abs(world.p_G[:, 0] - 5.0) < 1e-3
    in_opening = at_door & (np.abs(world.p_G[:, 1]) < 1.0) & (world.p_G[:, 2] < 2.4)
    assert at_door.any()
    assert not in_opening.any()


def test_identical_rooms_share_their_looks_but_for_a_few_points() -> None:
    options = sim.WorldOptions(
        rooms=3, landmarks_per_room=1000, identical_rooms=True, distinct_share=0.1
    )
    world = make_world(options, np.random.default_rng(0))
    _, first, count = np.unique(world.look, return_index=True, return_counts=True)
    assert np.sum(count == 3) > 800
    assert np.sum(world.look >= 900) > 250
    assert np.all(count[world.look[first] >= 900] == 1)
    repeated = np.flatnonzero(world.look == world.look[first[count == 3][0]])
    places = world.p_G[repeated]
    np.testing.assert_allclose(np.diff(places[:, 0]), options.room_size_m[0])
    np.testing.assert_allclose(np.ptp(places[:, 1:], axis=0), 0.0, atol=1e-12)


CORRIDOR = sim.WorldOptions(
    layout="corridor", floors=3, room_size_m=(20.0, 14.0, 3.0), landmarks_per_room=2000
)


def test_corridors_leave_block_and_stairwells_free() -> None:
    world = make_world(CORRIDOR, np.random.default_rng(0))
    assert world.bounds[1, 2] == 9.0
    block = np.all(np.abs(world.p_G[:, :2]) < np.array([7.5, 4.5]) - 1e-3, axis=1)
    assert not block.any()
    at_slab = np.abs(world.p_G[:, 2] - 3.0) < 1e-3
    in_well = (np.abs(world.p_G[:, 0]) > 7.5 + 1e-3) & (np.abs(world.p_G[:, 1]) < 3.0)
    horizontal = np.abs(world.normal_G[:, 2]) > 0.5
    assert np.any(at_slab & horizontal)
    assert not np.any(at_slab & in_well & horizontal)


def test_floors_see_each_other_through_the_stairwell_only() -> None:
    world = make_world(CORRIDOR, np.random.default_rng(0))
    eye = np.array([[8.75, 0.0, 1.5], [0.0, -5.75, 1.5], [0.0, -5.75, 1.5]])
    points = np.array([[8.75, 1.0, 4.5], [0.0, -5.75, 4.5], [0.0, 5.75, 1.5]])
    np.testing.assert_array_equal(is_hidden(world.boxes, eye, points), [False, True, True])


def test_bare_surfaces_carry_few_landmarks() -> None:
    options = sim.WorldOptions(landmarks_per_room=4000, furniture_per_room=0, patchiness=0.0)
    even = make_world(options, np.random.default_rng(1))
    bare = make_world(dataclasses.replace(options, bare_share=0.5), np.random.default_rng(1))

    def per_side(p: np.ndarray, normal: np.ndarray) -> np.ndarray:
        return np.unique(normal, axis=0, return_counts=True)[1]

    ratio = per_side(bare.p_G, bare.normal_G) / per_side(even.p_G, even.normal_G)
    assert ratio.min() < 0.35
    assert ratio.max() > 1.0
