"""Truth files, errors against them, and evaluate_map, which sees every kind of error."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import UserError
from maplab_py.geometry import se3, so3, yaw
from maplab_py.simulation.evaluation import MapErrors, evaluate_map
from maplab_py.simulation.scenario import CalibrationOptions, OtherSensorOptions, SessionOptions
from maplab_py.simulation.simulate import SimulatedData, simulate
from maplab_py.simulation.truth import Truth, true_map
from maplab_py.vimap import VIMap, edits, merge
from tests.simulation.small import PERFECT, SMALL, simulated

CALIBRATION = CalibrationOptions(
    focal_sigma_px=3.0,
    centre_sigma_px=2.0,
    distortion_sigma=1e-3,
    camera_rotation_sigma_deg=1.0,
    camera_position_sigma_m=0.01,
    gyro_scale_sigma=0.01,
    accel_scale_sigma=0.02,
    gyro_misalignment_sigma=0.01,
    accel_misalignment_sigma=0.01,
    accel_rotation_sigma_deg=1.0,
)
SCENARIO = dataclasses.replace(
    SMALL,
    calibration=CALIBRATION,
    sessions=(SessionOptions(duration_s=14.0, turns=1.2),),
    other_sensors=OtherSensorOptions(
        loop_edges=20, loop_edge_false_share=0.3, loop_edge_min_gap_s=6.0
    ),
)


@pytest.fixture(scope="module")
def data() -> SimulatedData:
    return simulate(SCENARIO)


@pytest.fixture(scope="module")
def right(data: SimulatedData) -> VIMap:
    return true_map(data.maps[0], data.truth)


def _errors(vi_map: VIMap, data: SimulatedData) -> MapErrors:
    return evaluate_map(vi_map, data.truth)


def test_the_true_map_has_no_error(right: VIMap, data: SimulatedData) -> None:
    errors = _errors(right, data)
    for name in ("ate_m", "ate_each_m", "velocity_mps", "landmark_90_percent_m"):
        assert getattr(errors, name) < 1e-9
    assert errors.gyro_bias_radps == errors.accel_bias_mps2 == 0.0
    assert max(errors.tilt_deg, errors.heading_deg) < 1e-6
    calibration = dataclasses.asdict(errors.calibrations[0])
    assert all(value < 1e-6 for name, value in calibration.items() if name != "mission")
    assert (errors.merges, errors.false_merges) == (0, 0)


def test_wrong_states_show_where_they_are_wrong(right: VIMap, data: SimulatedData) -> None:
    vertices = right.vertices
    T = vertices.T_M_I.copy()
    # about a horizontal axis that turns with the vertices, so that no alignment takes it away
    angle = np.deg2rad(1.0) * np.where(np.arange(len(T)) % 2, 1.0, -1.0)
    tilt = so3.exp(np.stack([angle, 0.0 * angle, 0.0 * angle], axis=1))
    T[:, :4] = so3.multiply(tilt, T[:, :4])
    spoilt = right.replace(
        vertices=vertices.replace(
            T_M_I=T,
            v_M=so3.rotate(tilt, vertices.v_M * 1.1),
            gyro_bias=vertices.gyro_bias + np.array([0.0, 1e-3, 0.0]),
            accel_bias=vertices.accel_bias + np.array([0.0, 0.0, 0.02]),
        )
    )
    errors = _errors(spoilt, data)
    assert errors.ate_m < 1e-9
    assert errors.tilt_deg == pytest.approx(1.0, rel=0.01)
    assert errors.heading_deg < 0.02
    speed = np.sqrt(np.mean(np.sum(data.truth.v_G**2, axis=1)))
    assert errors.velocity_mps == pytest.approx(0.1 * speed, rel=1e-6)
    assert errors.gyro_bias_radps == pytest.approx(1e-3)
    assert errors.accel_bias_mps2 == pytest.approx(0.02)


def test_stored_calibrations_are_as_wrong_as_they_were_drawn(data: SimulatedData) -> None:
    error = _errors(data.maps[0], data).calibrations[0]
    assert 0.5 < error.focal_px < 9.0
    assert 0.3 < error.centre_px < 6.0
    assert 1e-4 < error.distortion < 4e-3
    assert 0.3 < error.camera_rotation_deg < 4.0
    assert 2e-3 < error.camera_position_m < 0.04
    assert 2e-3 < error.gyro_scale < 0.03
    assert 4e-3 < error.accel_scale < 0.06
    assert 1e-3 < error.gyro_misalignment < 0.03
    assert 1e-3 < error.accel_misalignment < 0.03
    assert 0.2 < error.accel_rotation_deg < 4.0


def test_deviations_belong_to_devices_and_partly_to_sessions() -> None:
    short = SessionOptions(duration_s=2.0, turns=0.1)
    sessions = (short, short, dataclasses.replace(short, device=1))
    scenario = dataclasses.replace(PERFECT, calibration=CALIBRATION, sessions=sessions)
    truth = simulate(scenario).truth
    np.testing.assert_array_equal(truth.imu_T_a[0], truth.imu_T_a[1])
    np.testing.assert_array_equal(truth.camera_parameters[0], truth.camera_parameters[1])
    np.testing.assert_array_equal(truth.imu_id[0], truth.imu_id[1])
    assert not np.array_equal(truth.imu_id[0], truth.imu_id[2])
    assert np.abs(truth.imu_T_a[0] - truth.imu_T_a[2]).max() > 1e-3
    passing = dataclasses.replace(CALIBRATION, session_share=0.1)
    truth = simulate(dataclasses.replace(scenario, calibration=passing)).truth
    assert 1e-5 < np.abs(truth.imu_T_a[0] - truth.imu_T_a[1]).max() < 0.02


def test_landmarks_that_are_off(right: VIMap, data: SimulatedData) -> None:
    p_I = right.landmarks.p_I + np.array([0.0, 0.3, 0.0])
    errors = _errors(right.replace(landmarks=right.landmarks.replace(p_I=p_I)), data)
    assert errors.landmark_median_m == pytest.approx(0.3)
    assert errors.landmarks > 300


def _merged(vi_map: VIMap, first: int, second: int) -> VIMap:
    """Give the observations of one landmark to another."""
    landmark = np.where(vi_map.keypoints.landmark == second, first, vi_map.keypoints.landmark)
    return vi_map.replace(keypoints=vi_map.keypoints.replace(landmark=landmark))


def test_right_and_wrong_merges_are_told_apart(right: VIMap, data: SimulatedData) -> None:
    point = data.truth.landmark_point
    before = _errors(right, data)
    assert before.missed_merges == len(point) - len(np.unique(point))
    values, first, count = np.unique(point, return_index=True, return_counts=True)
    twice = values[count == 2][0]
    one, two = np.flatnonzero(point == twice)
    good = _errors(_merged(right, int(one), int(two)), data)
    assert (good.merges, good.false_merges) == (1, 0)
    assert good.missed_merges == before.missed_merges - 1
    assert good.wrong_observations == before.wrong_observations
    single = first[count == 1][:2]
    bad = _errors(_merged(right, int(single[0]), int(single[1])), data)
    assert (bad.merges, bad.false_merges) == (1, 1)
    assert bad.missed_merges == before.missed_merges
    assert bad.wrong_observations > before.wrong_observations


def test_false_loop_edges_are_counted(right: VIMap, data: SimulatedData) -> None:
    errors = _errors(right, data)
    assert (errors.loop_edges, errors.false_loop_edges) == (20, 6)
    assert errors.false_loop_edges_trusted == 6
    table = right.loop_closure_edges
    switch = np.where(data.truth.loop_edge_is_true, 1.0, 0.0)
    rejected = right.replace(loop_closure_edges=table.replace(switch_variable=switch))
    assert _errors(rejected, data).false_loop_edges_trusted == 0


def test_maps_without_observations_have_no_landmark_error(
    right: VIMap, data: SimulatedData
) -> None:
    bare = edits.remove_observations(right, right.observations)
    errors = _errors(bare, data)
    assert (errors.landmarks, errors.landmark_median_m) == (0, None)
    assert math.isfinite(errors.ate_m)


def test_landmarks_on_moving_things_do_not_count() -> None:
    world = dataclasses.replace(PERFECT.world, moving_objects=3, landmarks_per_object=200)
    data = simulate(dataclasses.replace(PERFECT, world=world))
    right = true_map(data.maps[0], data.truth)
    moving = data.truth.point_moving[data.truth.landmark_point] >= 0
    assert moving.any()
    assert _errors(right, data).landmarks <= np.count_nonzero(~moving)


def test_truth_of_another_data_set_makes_no_true_map() -> None:
    other = simulate(dataclasses.replace(SMALL.with_seed(78), sessions=SMALL.sessions[:1]))
    with pytest.raises(UserError, match="another data set"):
        true_map(simulated().maps[0], other.truth)


def _true_map() -> VIMap:
    """Return the merged map with true poses, in a frame of its own."""
    merged, _ = merge.merge_maps(*simulated().maps)
    truth = simulated().truth
    T_own_G = yaw.to_pose([1.0, -2.0, 0.5, 0.8])
    T_M_I = se3.compose(se3.inverse(truth.T_G_M)[truth.vertex_mission], truth.T_G_I)
    return merged.replace(
        vertices=merged.vertices.replace(T_M_I=T_M_I),
        baseframes=merged.baseframes.replace(T_G_M=se3.compose(T_own_G, truth.T_G_M)),
    )


def test_truth_survives_its_file(tmp_path: Path) -> None:
    truth = simulated().truth
    truth.save(tmp_path / "truth.npz")
    back = Truth.load(tmp_path / "truth.npz")
    for field in dataclasses.fields(truth):
        np.testing.assert_array_equal(getattr(back, field.name), getattr(truth, field.name))


def test_files_that_are_no_truth(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such truth file"):
        Truth.load(tmp_path / "none.npz")
    (tmp_path / "bad.npz").write_bytes(b"something else")
    with pytest.raises(UserError, match=r"bad\.npz is not a truth file"):
        Truth.load(tmp_path / "bad.npz")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(UserError, match=r"other\.npz is not a truth file"):
        Truth.load(tmp_path / "other.npz")


def test_a_true_map_has_no_error_in_any_frame() -> None:
    errors = evaluate_map(_true_map(), simulated().truth)
    assert errors.ate_m < 1e-9
    assert errors.ate_each_m < 1e-9
    assert errors.scale == pytest.approx(1.0)
    for mission in errors.missions:
        assert mission.offset_m < 1e-9
        assert mission.yaw_deg < 1e-6


def test_a_misplaced_mission_shows_in_offset_and_yaw_alone() -> None:
    vi_map = _true_map()
    T_G_M = np.array(vi_map.baseframes.T_G_M)
    row = vi_map.missions.baseframe[1]
    middle = vi_map.T_G_I[vi_map.vertices.mission == 1, 4:].mean(axis=0)
    about = yaw.to_pose(np.append(middle, 0.0))
    turn = se3.compose(about, se3.compose(yaw.to_pose([0, 0, 0, 0.05]), se3.inverse(about)))
    T_G_M[row] = se3.compose(turn, T_G_M[row])
    moved = vi_map.replace(baseframes=vi_map.baseframes.replace(T_G_M=T_G_M))
    errors = evaluate_map(moved, simulated().truth)
    assert errors.ate_each_m < 1e-9
    assert errors.ate_m > 0.005
    total = sum(mission.yaw_deg for mission in errors.missions)
    assert total == pytest.approx(np.rad2deg(0.05), rel=1e-6)


def test_drift_is_seen_before_anything_is_done() -> None:
    merged, _ = merge.merge_maps(*simulated().maps)
    errors = evaluate_map(merged, simulated().truth)
    assert errors.ate_m > errors.ate_each_m > 0.003
    assert [mission.vertices for mission in errors.missions] == [31, 21]


def test_truth_of_another_data_set_is_refused() -> None:
    from maplab_py.simulation.simulate import simulate

    other = simulate(dataclasses.replace(SMALL.with_seed(77), sessions=SMALL.sessions[1:]))
    with pytest.raises(UserError, match="another data set"):
        evaluate_map(simulated().maps[0], other.truth)
