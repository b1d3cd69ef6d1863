"""Segments and information, and their database: sessions, capacity, file, outdated segments."""

import dataclasses
import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from maplab_py.algorithms.self_calibration import pruning
from maplab_py.algorithms.self_calibration.estimation.problem import (
    bias_gaps,
    build_segment_problem,
    partitions,
    runs_of,
    split_landmarks,
)
from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.algorithms.self_calibration.reports import PrunedSegment
from maplab_py.algorithms.self_calibration.segments.database import (
    SegmentDatabase,
    load_database,
    save_database,
)
from maplab_py.algorithms.self_calibration.segments.selection import collect, evaluate
from maplab_py.algorithms.self_calibration.segments.splitting import (
    extract_submap,
    split_into_segments,
)
from maplab_py.algorithms.self_calibration.uncertainty import (
    name_directions,
    posterior_covariance,
    score,
    spectrum,
)
from maplab_py.errors import EstimationError, UserError
from maplab_py.estimation.problem.marginals import Marginals
from maplab_py.progress import SILENT
from maplab_py.sensors import CameraRig, Distortion, SensorSet
from maplab_py.vimap import VIMap
from tests.algorithms.self_calibration.scenes import (
    OPTIONS,
    assert_only_gaps,
    device,
    scene_map,
    uncalibrated,
)


def test_segments_share_their_boundary_and_cover_the_mission() -> None:
    rows = split_into_segments(scene_map(), None, 11)
    assert [(int(one[0]), int(one[-1])) for one in rows] == [(0, 10), (10, 20), (20, 30)]


def test_segments_are_not_cut_across_a_missing_edge() -> None:
    vi_map = scene_map()
    broken = vi_map.replace(
        imu_edges=vi_map.imu_edges.replace(
            from_vertex=np.where(vi_map.imu_edges.from_vertex == 5, 6, vi_map.imu_edges.from_vertex)
        )
    )
    for rows in split_into_segments(broken, None, 11):
        assert not (rows[0] <= 5 < rows[-1])


def test_a_restricted_map_keeps_states_tracks_and_samples() -> None:
    vi_map = scene_map()
    rows = np.concatenate([np.arange(3, 12), np.arange(20, 28)])
    small = extract_submap(vi_map, rows)
    assert_only_gaps(small)
    np.testing.assert_array_equal(small.vertices.T_M_I, vi_map.vertices.T_M_I[rows])
    assert len(small.imu_edges) == 8 + 7
    assert runs_of(small).tolist() == [0] * 9 + [1] * 8
    kept = vi_map.landmark_index.rows(small.landmarks.id)
    np.testing.assert_allclose(small.p_G, vi_map.p_G[kept], atol=1e-12)
    observers = [np.unique(small.keypoint_vertex[small.keypoints.landmark == k]) for k in range(9)]
    assert min(map(len, observers)) >= 2


def test_gaps_are_bridged_within_a_mission_only() -> None:
    small = extract_submap(scene_map(), np.concatenate([np.arange(0, 5), np.arange(15, 20)]))
    gaps = bias_gaps(small)
    assert (gaps.before.tolist(), gaps.after.tolist()) == ([4], [5])
    assert gaps.duration_s[0] == pytest.approx(11 * 0.2)


def shared_landmarks(vi_map, a, b) -> int:
    label = runs_of(vi_map)
    seen = [
        set(vi_map.keypoints.landmark[(label[vi_map.keypoint_vertex] == k)].tolist()) - {-1}
        for k in (a, b)
    ]
    return len(seen[0] & seen[1])


def test_partitions_grow_together_above_the_threshold_only() -> None:
    small = extract_submap(scene_map(), np.concatenate([np.arange(0, 8), np.arange(10, 18)]))
    shared = shared_landmarks(small, 0, 1)
    assert shared > 3
    assert partitions(small, shared).max() == 1
    assert partitions(small, shared - 1).max() == 0


def test_partitions_have_landmarks_of_their_own() -> None:
    small = extract_submap(scene_map(), np.concatenate([np.arange(0, 8), np.arange(10, 18)]))
    label = partitions(small, 10**6)
    split = split_landmarks(small, label)
    assert_only_gaps(split)
    assert shared_landmarks(split, 0, 1) == 0
    before = np.sort(small.keypoints.uv_px[small.keypoints.landmark >= 0], axis=0)
    assert 0.9 * len(before) <= np.count_nonzero(split.keypoints.landmark >= 0) <= len(before)


def test_every_partition_has_one_gauge() -> None:
    small = extract_submap(scene_map(), np.concatenate([np.arange(0, 8), np.arange(10, 18)]))
    joined = build_segment_problem(small, OPTIONS)
    apart = build_segment_problem(small, dataclasses.replace(OPTIONS, min_shared_landmarks=10**6))
    assert (joined.num_partitions, apart.num_partitions) == (1, 2)
    difference = joined.problem.degrees_of_freedom() - apart.problem.degrees_of_freedom()
    assert difference == 4


def test_covariance_is_the_block_of_the_inverse() -> None:
    problem = build_segment_problem(scene_map(noise=1.0), OPTIONS, robust=False)
    states = problem.states
    node, direction = problem.parameters.nodes(states)
    covariance = posterior_covariance(problem, states)
    unique = np.unique(node)
    full = Marginals(problem.problem, states).nodes(unique)
    column = 3 * np.searchsorted(unique, node) + direction
    sigma = np.sqrt(np.diag(covariance))
    difference = (covariance - full[np.ix_(column, column)]) / np.outer(sigma, sigma)
    np.testing.assert_allclose(difference, 0.0, atol=1e-3)


def test_more_data_are_more_informative() -> None:
    vi_map = scene_map(noise=1.0)
    small, large = (
        posterior_covariance(p, p.states)
        for p in (
            build_segment_problem(extract_submap(vi_map, np.arange(n)), OPTIONS, robust=False)
            for n in (12, 31)
        )
    )
    assert np.linalg.eigvalsh(small - large).min() >= -1e-9 * np.abs(small).max()


@pytest.mark.parametrize("metric", ["a_optimality", "d_optimality", "e_optimality", "entropy"])
def test_scores_of_a_known_covariance(metric: str) -> None:
    sigma = np.array([0.5, 2.0, 3.0])
    covariance = np.diag((sigma * [1.0, 2.0, 3.0]) ** 2)
    rows = np.array([1, 2])
    wanted = {
        "a_optimality": 4.0 + 9.0,
        "d_optimality": np.log(36.0),
        "e_optimality": 9.0,
        "entropy": 0.5 * np.log((2.0 * np.pi * np.e) ** 2 * 36.0),
    }
    assert score(covariance, sigma, rows, metric) == pytest.approx(wanted[metric])


def test_an_undetermined_direction_is_found_and_named() -> None:
    problem = build_segment_problem(scene_map(noise=1.0), OPTIONS, robust=False)
    parameters = problem.parameters
    scale = parameters.prior_sigma
    covariance = np.diag((0.01 * scale) ** 2)
    k = parameters.names.index("gyroscope z scale")
    covariance[k, k] = scale[k] ** 2
    unknown = spectrum(covariance, parameters).unobservable()
    assert unknown.shape[1] == 1
    assert name_directions(unknown, parameters) == ("gyroscope z scale",)


def test_the_most_informative_segments_are_kept() -> None:
    vi_map = scene_map(vertices=61, noise=1.0)
    database, report = collect(vi_map, OPTIONS)
    evaluation = evaluate(vi_map, OPTIONS)
    assert report.segments_evaluated == len(evaluation.segments) == 7
    rows = evaluation.parameters.of_groups(("imu",))
    scores = np.sort(
        [
            score(one.covariance, database.sigma_ref, rows, "a_optimality")
            for one in evaluation.segments
        ]
    )
    kept = [one.scores["imu"] for one in database.ranked("imu")]
    np.testing.assert_allclose(kept, scores[:2], rtol=1e-6)
    assert set(database.members()) == {one.key for one in database.records}


@cache
def collected() -> SegmentDatabase:
    return collect(scene_map(vertices=61, noise=1.0), OPTIONS)[0]


def test_a_file_returns_the_database(tmp_path: Path) -> None:
    database, path = collected(), tmp_path / "device.segments"
    save_database(database, path)
    again = load_database(path)
    assert again.records == database.records
    assert (again.tables, again.metric, again.capacity) == (
        dict(database.tables),
        database.metric,
        database.capacity,
    )
    for name in ("vertices", "keypoints", "landmarks", "imu_edges", "imu_samples"):
        for column, values in getattr(database.vi_map, name).columns().items():
            np.testing.assert_array_equal(getattr(getattr(again.vi_map, name), column), values)
    save_database(again, tmp_path / "again.segments")
    assert (tmp_path / "again.segments").read_bytes() == path.read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["again.segments", "device.segments"]


def test_a_file_with_the_columns_of_before_is_read(tmp_path: Path) -> None:
    database, path, old = collected(), tmp_path / "new.segments", tmp_path / "old.segments"
    save_database(database, path)
    with np.load(path) as archive:
        arrays = {name: archive[name] for name in archive.files}
    del arrays["frames/descriptor_layout"]
    arrays["frames/descriptor_size"] = np.zeros(len(database.vi_map.frames), dtype=np.int32)
    with old.open("wb") as file:
        np.savez_compressed(file, **arrays)
    assert load_database(old).records == database.records
    save_database(load_database(old), tmp_path / "again.segments")
    assert (tmp_path / "again.segments").read_bytes() == path.read_bytes()


def test_damaged_foreign_and_newer_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "device.segments"
    with pytest.raises(UserError, match="no such segment database"):
        load_database(path)
    save_database(collected(), path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(UserError, match="damaged"):
        load_database(path)
    header = json.dumps({"format": "maplab-py segment database", "version": 99}).encode()
    with path.open("wb") as file:
        np.savez(file, header=np.frombuffer(header, dtype=np.uint8))
    with pytest.raises(UserError, match="version 99"):
        load_database(path)


def second_session() -> VIMap:
    """Another walk with the same device."""
    other = scene_map(vertices=61, noise=1.0, seed=2, device_seed=1)
    for one, same in zip(device(other), device(collected().vi_map), strict=True):
        assert one.id == same.id
    np.testing.assert_array_equal(device(other)[1].T_B_C, device(collected().vi_map)[1].T_B_C)
    return other


def test_sessions_compete_and_the_size_stays() -> None:
    database = collected()
    grown, report = collect(second_session(), OPTIONS, database)
    assert_only_gaps(grown.vi_map)
    assert len(grown) <= 3 * OPTIONS.segments_per_group
    assert report.dropped + len(database) - report.segments_kept + report.from_this_map == (
        2 * report.dropped
    )
    for table in grown.tables:
        best = sorted(one.scores[table] for one in grown.records)[: grown.capacity]
        assert [one.scores[table] for one in grown.ranked(table)] == best
    np.testing.assert_array_equal(grown.sigma_ref, database.sigma_ref)


def test_a_mission_that_comes_again_replaces_its_segments() -> None:
    database = collected()
    again, _ = collect(scene_map(vertices=61, noise=1.0), OPTIONS, database)
    assert {one.key for one in again.records} == {one.key for one in database.records}
    assert len(again.vi_map.vertices) == len(database.vi_map.vertices)


def test_other_states_need_another_database() -> None:
    with pytest.raises(UserError, match="--sc_states"):
        collect(second_session(), dataclasses.replace(OPTIONS, states="imu"), collected())


def test_pruning_keeps_the_best() -> None:
    database = collected()
    one = database.pruned(1)
    assert len(one) <= 3
    for table in one.tables:
        assert one.ranked(table)[0].key == database.ranked(table)[0].key


def seen_by(vi_map: VIMap, sensors: SensorSet) -> VIMap:
    """Return the map as a camera of other focal length and centre would have recorded it."""
    (f, c), (other_f, other_c) = (
        np.split(device(vi_map.replace(sensors=one))[1].cameras[0].intrinsics, 2)
        for one in (vi_map.sensors, sensors)
    )
    uv_px = (vi_map.keypoints.uv_px - c) / f * other_f + other_c
    return vi_map.replace(keypoints=vi_map.keypoints.replace(uv_px=uv_px))


def knocked(sensors: SensorSet) -> SensorSet:
    """Focal length and centre of a camera that was dropped."""
    rig = next(one for one in sensors.sensors.values() if isinstance(one, CameraRig))
    camera = rig.cameras[0]
    other = dataclasses.replace(
        camera, intrinsics=camera.intrinsics + np.array([12.0, 12.0, 20.0, -15.0])
    )
    changed = {**sensors.sensors, rig.id: CameraRig(rig.id, (other,), rig.T_B_C)}
    return dataclasses.replace(sensors, sensors=changed)


def renamed(sensors: SensorSet) -> SensorSet:
    """Return the same device under other ids, as another recording may have it."""
    other = {key: key[::-1] for key in sensors.sensors}
    return SensorSet(
        {
            other[key]: dataclasses.replace(one, id=other[key])
            for key, one in sensors.sensors.items()
        },
        {
            other[key]: dataclasses.replace(one, base_sensor_id=other[one.base_sensor_id])
            for key, one in sensors.extrinsics.items()
        },
    )


def results_of(
    database: SegmentDatabase, sensors: SensorSet, options: SelfCalibrationOptions
) -> list[PrunedSegment]:
    return pruning.test_segments(database, sensors, options, pruning.PROBABILITY, SILENT)


def mutual_results_of(
    database: SegmentDatabase, options: SelfCalibrationOptions
) -> list[PrunedSegment]:
    return pruning.test_mutual_consistency(database, options, pruning.PROBABILITY, SILENT)


def test_a_calibration_of_other_cameras_is_not_passed_over() -> None:
    other = scene_map(vertices=61, seed=3, distortion=Distortion.RADTAN).sensors
    with pytest.raises(UserError, match="of other cameras"):
        results_of(collected(), other, OPTIONS)


@pytest.mark.slow
def test_segments_of_a_device_that_changed_are_found() -> None:
    database = collected()
    sensors = database.vi_map.sensors
    assert not any(one.outdated for one in results_of(database, sensors, OPTIONS))
    assert all(one.outdated for one in results_of(database, knocked(sensors), OPTIONS))
    assert all(one.outdated for one in results_of(database, renamed(knocked(sensors)), OPTIONS))


@pytest.mark.slow
def test_a_calibration_that_was_wrong_from_the_start_makes_no_segment_outdated() -> None:
    database, _ = collect(uncalibrated(scene_map(vertices=61, noise=1.0)), OPTIONS)
    assert all(one.outdated for one in results_of(database, database.vi_map.sensors, OPTIONS))
    assert not any(one.outdated for one in mutual_results_of(database, OPTIONS))


@pytest.mark.slow
def test_segments_from_before_and_after_a_knock_are_told_apart() -> None:
    many = dataclasses.replace(OPTIONS, segments_per_group=20)
    first, _ = collect(scene_map(vertices=61, noise=1.0), many)
    held, now = first.vi_map.sensors, knocked(first.vi_map.sensors)
    database, _ = collect(seen_by(second_session(), now), many, first)
    is_first = [one.mission in {r.mission for r in first.records} for one in database.records]
    assert 0 < sum(is_first) < len(is_first)
    assert [one.outdated for one in results_of(database, held, many)] == [
        not one for one in is_first
    ]
    assert [one.outdated for one in results_of(database, now, many)] == is_first
    with pytest.raises(EstimationError, match=r"changed between sessions.*--calibration"):
        mutual_results_of(database, many)
