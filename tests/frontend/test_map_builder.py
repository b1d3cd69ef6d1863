"""Maps built from states, keypoints and samples: a replayed mission is rebuilt as it was."""

import dataclasses
from concurrent.futures import Future
from pathlib import Path

import numpy as np
import pytest

from maplab_py.algorithms.vi_optimization.optimization import optimize
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.errors import EstimationError, FlagError
from maplab_py.frontend.map_builder import MapBuilder
from maplab_py.frontend.recorded_mission import RecordedMission
from maplab_py.frontend.run_options import MapBuilderOptions
from maplab_py.interop.recordings.map_replay import MapRecording
from maplab_py.interop.recordings.protocol import (
    ImuBatch,
    RecordedSensors,
    TrackedFrame,
    TrackedFrameSet,
)
from maplab_py.interop.recordings.stream import EventStream
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import simulate
from maplab_py.storage.native import load_map, save_map
from maplab_py.storage.resources.store import ResourceStore
from maplab_py.vimap import VIMap, to_hex
from maplab_py.vimap.comparison import is_same
from maplab_py.vimap.consistency import check_consistency
from maplab_py.vimap.descriptors import FeatureType, types_of
from maplab_py.vimap.nav_state import NavState
from maplab_py.vimap.tables import MissionSensor
from tests.interop.small_map import make_map
from tests.support.float_features import with_numbers

OFTEN = MapBuilderOptions(nframe_sync_max_output_frequency_hz=1000.0)


@pytest.fixture(scope="module")
def stereo() -> VIMap:
    scenario = load_scenario("stereo_room")
    session = dataclasses.replace(scenario.sessions[0], duration_s=6.0, phases=())
    return simulate(dataclasses.replace(scenario, sessions=(session,))).maps[0]


def states_of(vi_map: VIMap, vertex: int) -> NavState:
    v = vi_map.vertices
    return NavState.single(
        int(v.timestamp_ns[vertex]),
        v.T_M_I[vertex],
        v.v_M[vertex],
        v.gyro_bias[vertex],
        v.accel_bias[vertex],
    )


def rebuilt(
    vi_map: VIMap, builder: MapBuilder, mission: int = 0, device: RecordedSensors | None = None
) -> None:
    """Add a mission of a map to a builder."""
    recording = MapRecording(vi_map, mission)
    builder.start_mission(device)
    vertex = int(vi_map.vertex_start[mission])
    times_ns, samples = np.zeros(0, dtype=np.int64), np.zeros((0, 6))
    for event in EventStream(recording):
        if isinstance(event, ImuBatch):
            times_ns = np.concatenate([times_ns, event.times_ns])
            samples = np.concatenate([samples, event.accel_gyro])
        elif isinstance(event, TrackedFrameSet):
            builder.missions[-1].add_imu(times_ns, samples)
            times_ns, samples = times_ns[-1:], samples[-1:]
            if builder.is_due(event.time_ns):
                builder.add_vertex(states_of(vi_map, vertex), event.frames)
            vertex += 1


def test_a_replayed_mission_is_rebuilt(stereo: VIMap) -> None:
    builder = MapBuilder(MapRecording(stereo, 0).device, OFTEN)
    rebuilt(stereo, builder)
    result = builder.make_map()
    assert check_consistency(result).failure == ""
    assert not check_consistency(result).warnings
    for name in ("T_M_I", "v_M", "gyro_bias", "accel_bias", "timestamp_ns"):
        np.testing.assert_array_equal(
            getattr(result.vertices, name), getattr(stereo.vertices, name)
        )
    for name in ("uv_px", "sigma_px", "scale", "track_id", "descriptor"):
        np.testing.assert_array_equal(
            getattr(result.keypoints, name), getattr(stereo.keypoints, name)
        )
    assert is_same(result.imu_samples, stereo.imu_samples)
    np.testing.assert_array_equal(result.imu_edges.sample_count, stereo.imu_edges.sample_count)
    np.testing.assert_array_equal(result.binary_descriptor_size, stereo.binary_descriptor_size)
    first = result.imu_samples.take(result.sample_start[1:-1])
    last = result.imu_samples.take(result.sample_start[1:-1] - 1)
    assert is_same(first, last)


def test_descriptors_of_numbers_are_replayed_and_rebuilt(stereo: VIMap) -> None:
    numbers = with_numbers(stereo, FeatureType.XFEAT)
    builder = MapBuilder(MapRecording(numbers, 0).device, OFTEN)
    rebuilt(numbers, builder)
    result = builder.make_map()
    assert check_consistency(result).failure == ""
    np.testing.assert_array_equal(result.keypoints.descriptor, numbers.keypoints.descriptor)
    assert list(result.frames.descriptor_blocks) == list(numbers.frames.descriptor_blocks)


def test_equal_input_gives_equal_maps_and_other_sessions_other_ids(stereo: VIMap) -> None:
    a, b = (MapBuilder(MapRecording(stereo, 0).device, OFTEN) for _ in range(2))
    rebuilt(stereo, a)
    rebuilt(stereo, b)
    assert is_same(a.finish()[0], b.finish()[0])
    two = make_map()
    both = MapBuilder(MapRecording(two, 0).device, OFTEN)
    for mission in (0, 1):
        rebuilt(two, both, mission)
    result = both.make_map()
    assert len(both.missions) == len(result.missions) == 2
    assert check_consistency(result).failure == ""


@pytest.mark.parametrize("is_renamed", [False, True])
def test_missions_keep_their_sensors_unless_the_ids_are_the_same(
    monkeypatch: pytest.MonkeyPatch, *, is_renamed: bool
) -> None:
    two, used = make_map(), []
    device = MapRecording(two, 0).device
    assert device.imu is not None
    noisy = device.with_sensor(dataclasses.replace(device.imu, gyro_noise_density=0.5))
    noisy = noisy.renamed() if is_renamed else noisy
    builder = MapBuilder(device, OFTEN)
    rebuilt(two, builder, 0)
    rebuilt(two, builder, 1, noisy)
    ids = builder.make_map().missions.sensor_id[:, int(MissionSensor.IMU)]
    sensors = builder.make_map().sensors
    noise = [sensors.imu(to_hex(imu)).gyro_noise_density for imu in ids]
    assert noise == [device.imu.gyro_noise_density if is_renamed else 0.5, 0.5]
    monkeypatch.setattr(RecordedMission, "tie_to", lambda *args: used.append(args[-1]))
    builder.ties()
    assert used == [device.imu if is_renamed else noisy.imu]


def test_landmarks_join_the_cameras_and_can_be_optimised(stereo: VIMap, tmp_path: Path) -> None:
    builder = MapBuilder(MapRecording(stereo, 0).device, MapBuilderOptions())
    rebuilt(stereo, builder)
    result, report = builder.finish()
    assert report.landmarks_added == len(result.landmarks) > 100
    assert check_consistency(result).failure == ""
    save_map(result, tmp_path / "map")
    loaded, _ = load_map(tmp_path / "map")
    assert len(loaded.landmarks) == len(result.landmarks)
    optimised, costs = optimize(loaded, VIOptimizationOptions(num_iterations=5))
    assert costs.cost_after < costs.cost_before
    assert check_consistency(optimised).failure == ""


def test_vertices_come_at_most_at_the_given_rate(stereo: VIMap) -> None:
    builder = MapBuilder(
        MapRecording(stereo, 0).device, MapBuilderOptions(nframe_sync_max_output_frequency_hz=3.0)
    )
    rebuilt(stereo, builder)
    result = builder.make_map()
    assert np.diff(result.vertices.timestamp_ns).min() >= 0.95 * 1e9 / 3.0
    assert len(result.vertices) < 0.5 * len(stereo.vertices)
    assert check_consistency(result).failure == ""
    first, last = result.sample_start[:-1], result.sample_start[1:] - 1
    times_ns = result.imu_samples.timestamp_ns
    np.testing.assert_array_equal(times_ns[first], result.vertices.timestamp_ns[:-1])
    np.testing.assert_array_equal(times_ns[last], result.vertices.timestamp_ns[1:])


def test_final_estimates_replace_the_first(stereo: VIMap) -> None:
    builder = MapBuilder(MapRecording(stereo, 0).device, OFTEN)
    rebuilt(stereo, builder)
    moved = np.array([[0.0, 0.0, 0.0, 1.0, 1.0, 2.0, 3.0]])
    wanted = dataclasses.replace(states_of(stereo, 2), T_M_I=moved)
    other = dataclasses.replace(wanted, time_ns=wanted.time_ns + 1)  # no vertex has this time
    builder.missions[-1].refine(NavState.stack([wanted, other]))
    result = builder.make_map()
    np.testing.assert_array_equal(result.vertices.T_M_I[2], wanted.T_M_I[0])
    np.testing.assert_array_equal(result.vertices.T_M_I[3], stereo.vertices.T_M_I[3])


def test_images_become_resources_of_frames(stereo: VIMap, tmp_path: Path) -> None:
    options = dataclasses.replace(OFTEN, save_image_as_resources=True)
    device = MapRecording(stereo, 0).device
    builder = MapBuilder(device, options)
    builder.start_mission()
    frames = [e for e in EventStream(MapRecording(stereo, 0)) if isinstance(e, TrackedFrameSet)]
    samples = np.zeros((2, 6))
    for row in range(3):
        if row:
            times_ns = np.array([frames[row - 1].time_ns, frames[row].time_ns])
            builder.missions[-1].add_imu(times_ns, samples)
        images = [np.full((4, 6), 10 * row + camera, dtype=np.uint8) for camera in range(2)]
        builder.add_vertex(states_of(stereo, row), frames[row].frames, images)
    result, _ = builder.finish()
    assert check_consistency(result).failure == ""
    assert len(result.resources) == 6
    save_map(result, tmp_path / "map")
    loaded, _ = load_map(tmp_path / "map")
    store = ResourceStore(loaded, tmp_path / "map")
    for row in range(6):
        owner = int(loaded.resources.owner[row])
        vertex, camera = divmod(owner, 2)
        np.testing.assert_array_equal(store.load(row), np.full((4, 6), 10 * vertex + camera))


def test_missing_frames_keep_their_slot(stereo: VIMap) -> None:
    builder = MapBuilder(MapRecording(stereo, 0).device, OFTEN)
    builder.start_mission()
    sets = [e for e in EventStream(MapRecording(stereo, 0)) if isinstance(e, TrackedFrameSet)]
    builder.add_vertex(states_of(stereo, 0), sets[0].frames)
    builder.missions[-1].add_imu(np.array([sets[0].time_ns, sets[1].time_ns]), np.zeros((2, 6)))
    builder.add_vertex(states_of(stereo, 1), (None, empty(sets[1].frames[1])))
    result = builder.make_map()
    assert check_consistency(result).failure == ""
    assert result.frames.is_valid.tolist() == [True, True, False, True]
    assert result.frames.keypoint_count.tolist()[2:] == [0, 0]


def test_vertices_may_be_described_later_and_otherwise(stereo: VIMap) -> None:
    numbers = with_numbers(stereo, FeatureType.XFEAT)
    builder = MapBuilder(MapRecording(stereo, 0).device, OFTEN)
    builder.start_mission()
    sets, described = (
        [e for e in EventStream(MapRecording(each, 0)) if isinstance(e, TrackedFrameSet)][:6]
        for each in (stereo, numbers)
    )
    later: list[Future[tuple[TrackedFrame, ...]]] = [Future() for _ in sets]
    for row, frame_set in enumerate(sets):
        if row:
            times_ns = np.array([sets[row - 1].time_ns, frame_set.time_ns])
            builder.missions[-1].add_imu(times_ns, np.zeros((2, 6)))
        frames = frame_set.frames if row % 2 else later[row]
        builder.add_vertex(states_of(stereo, row), frames, [None] * 2)
    for future, frame_set in zip(later, described, strict=True):
        future.set_result(tuple(frame for frame in frame_set.frames if frame is not None))
    result, _ = builder.finish()
    assert check_consistency(result).failure == ""
    assert types_of(result.frames) == {FeatureType.BINARY, FeatureType.XFEAT}
    of_vertex = result.keypoint_vertex % 2 == 0
    assert np.array_equal(result.feature_type == FeatureType.XFEAT, of_vertex)
    assert set(result.landmarks.feature_type.tolist()) == types_of(result.frames)


def empty(frame: TrackedFrame | None) -> TrackedFrame:
    assert frame is not None
    names = ("uv_px", "sigma_px", "scale", "track_id", "descriptor", "descriptor_size")
    return dataclasses.replace(frame, **{name: getattr(frame, name)[:0] for name in names})


def test_what_makes_no_map() -> None:
    vi_map = make_map()
    builder = MapBuilder(MapRecording(vi_map, 0).device)
    builder.start_mission()
    builder.add_vertex(states_of(vi_map, 0), (None,))
    with pytest.raises(EstimationError, match="fewer than two vertices"):
        builder.make_map()
    with pytest.raises(FlagError, match="max_output_frequency_hz=0: must be above 0"):
        MapBuilder(
            MapRecording(vi_map, 0).device,
            MapBuilderOptions(nframe_sync_max_output_frequency_hz=0.0),
        )
