"""Whole sessions: consistent, exact at truth without noise, repeatable; the demonstration."""

import dataclasses
import time
from pathlib import Path

import numpy as np
import pytest

from maplab_py.geometry import se3
from maplab_py.sensors.projection import project
from maplab_py.simulation import demo, scenario_file
from maplab_py.simulation.scenario import Scenario, Seeds, SessionOptions
from maplab_py.simulation.simulate import SessionSimulator, SimulatedData, simulate
from maplab_py.vimap import VIMap, consistency, merge
from tests.simulation.small import PERFECT, SMALL, simulated
from tests.support.machine import slowness


def _tables(vi_map: VIMap) -> dict[str, bytes]:
    tables = {}
    for field in dataclasses.fields(vi_map):
        table = getattr(vi_map, field.name)
        if hasattr(table, "columns"):
            for name, column in table.columns().items():
                data = (
                    repr(column.tolist()).encode() if column.dtype == object else column.tobytes()
                )
                tables[f"{field.name}.{name}"] = data
    return tables


def _true_residuals(data: SimulatedData) -> np.ndarray:
    """Return measured minus true pixels (O, 2) of the first session's observations."""
    vi_map, truth = data.maps[0], data.truth
    keypoints = vi_map.observations
    landmark = vi_map.keypoints.landmark[keypoints]
    T_G_I = truth.T_G_I[vi_map.keypoint_vertex[keypoints]]
    rig = next(s for s in vi_map.sensors.sensors.values() if hasattr(s, "cameras"))
    camera = vi_map.frames.camera_index[vi_map.keypoint_frame[keypoints]]
    T_G_C = se3.compose(T_G_I, rig.T_B_C[camera])
    point = truth.point_G[truth.landmark_point[landmark]]
    p_C = se3.transform(se3.inverse(T_G_C), point)
    residuals = np.empty((len(keypoints), 2))
    for row, one in enumerate(rig.cameras):
        own = camera == row
        uv, visible = project(one, p_C[own])
        assert visible.all()
        residuals[own] = vi_map.keypoints.uv_px[keypoints[own]] - uv
    return residuals


def test_maps_are_consistent_and_merge() -> None:
    data = simulated()
    merged, _ = merge.merge_maps(*data.maps)
    for vi_map in (*data.maps, merged):
        report = consistency.check_consistency(vi_map)
        assert report.errors == ()
        assert report.warnings == ()
    assert len(merged.missions) == 2
    assert len(merged.sensors.sensors) == 2


def test_without_noise_initial_states_are_true() -> None:
    data = simulated(PERFECT)
    vi_map, truth = data.maps[0], data.truth
    T_G_I = se3.compose(truth.T_G_M[0], vi_map.vertices.T_M_I)
    np.testing.assert_allclose(se3.local(T_G_I, truth.T_G_I), 0.0, atol=1e-12)
    p_G = se3.transform(T_G_I[vi_map.landmarks.vertex], vi_map.landmarks.p_I)
    np.testing.assert_allclose(p_G, truth.point_G[truth.landmark_point], atol=1e-6)


def test_swapped_identities_are_gross_errors() -> None:
    measurement = dataclasses.replace(SMALL.measurement, identity_swap_share=0.2)
    error = np.linalg.norm(
        _true_residuals(simulate(dataclasses.replace(SMALL, measurement=measurement))), axis=1
    )
    assert 0.005 < np.mean(error > 6.0) < 0.2


def test_same_seed_same_bytes() -> None:
    again = simulate(SMALL)
    for one, two in zip(simulated().maps, again.maps, strict=True):
        assert _tables(one) == _tables(two)
    for field in dataclasses.fields(again.truth):
        one, two = getattr(simulated().truth, field.name), getattr(again.truth, field.name)
        assert one.tobytes() == two.tobytes()


def _with_seeds(**seeds: int) -> SimulatedData:
    return simulate(dataclasses.replace(SMALL, seeds=dataclasses.replace(Seeds(), **seeds)))


def test_seeds_are_independent() -> None:
    base = simulated()
    measurement = _with_seeds(measurement=9)
    np.testing.assert_array_equal(measurement.truth.T_G_I, base.truth.T_G_I)
    np.testing.assert_array_equal(measurement.truth.point_G, base.truth.point_G)
    assert not np.array_equal(
        measurement.maps[0].imu_samples.accel_gyro, base.maps[0].imu_samples.accel_gyro
    )
    motion = _with_seeds(motion=9)
    np.testing.assert_array_equal(motion.truth.point_G, base.truth.point_G)
    assert not np.array_equal(motion.truth.T_G_I, base.truth.T_G_I)
    world = _with_seeds(world=9)
    np.testing.assert_array_equal(world.truth.T_G_I, base.truth.T_G_I)
    assert not np.array_equal(world.truth.point_G, base.truth.point_G)
    look = _with_seeds(appearance=9)
    np.testing.assert_array_equal(look.truth.T_G_I, base.truth.T_G_I)
    np.testing.assert_array_equal(look.truth.point_G, base.truth.point_G)
    assert not np.array_equal(look.maps[0].keypoints.descriptor, base.maps[0].keypoints.descriptor)


def test_edges_begin_and_end_at_their_vertices() -> None:
    vi_map = simulated().maps[0]
    time_ns, edges = vi_map.vertices.timestamp_ns, vi_map.imu_edges
    samples = vi_map.imu_samples.timestamp_ns
    np.testing.assert_array_equal(samples[vi_map.sample_start[:-1]], time_ns[edges.from_vertex])
    np.testing.assert_array_equal(samples[vi_map.sample_start[1:] - 1], time_ns[edges.to_vertex])
    np.testing.assert_allclose(np.diff(time_ns), 2e8, atol=1.0)


def test_sessions_drift_and_know_nothing_of_their_frames() -> None:
    data = simulated()
    for vi_map in data.maps:
        assert not vi_map.baseframes.is_known.any()
        assert np.all(vi_map.landmarks.quality == 0)
        np.testing.assert_allclose(vi_map.vertices.T_M_I[0, 4:], 0.0, atol=1e-12)
    drifted = se3.compose(data.truth.T_G_M[0], data.maps[0].vertices.T_M_I)
    error = np.linalg.norm((drifted - data.truth.T_G_I[: len(drifted)])[:, 4:], axis=1)
    assert 0.005 < error.max() < 1.0


def test_clutter_and_broken_tracks() -> None:
    vi_map = simulated().maps[0]
    clutter = vi_map.keypoints.track_id < 0
    assert np.mean(clutter) == pytest.approx(0.2, abs=0.03)
    assert np.all(vi_map.keypoints.landmark[clutter] == -1)
    points, counts = np.unique(simulated().truth.landmark_point, return_counts=True)
    assert len(points) > 100
    assert counts.max() > 1


@pytest.mark.slow
def test_long_session_takes_at_most_20_seconds() -> None:
    scenario = scenario_file.load_scenario("single_session")
    # processor time: others may be at work on the machine
    start = time.process_time()
    data = simulate(scenario)
    seconds = time.process_time() - start
    vi_map = data.maps[0]
    assert len(vi_map.vertices) == 1201
    assert np.mean(vi_map.frames.keypoint_count) > 500
    assert seconds <= 20.0 * slowness()


def test_straight_turns_in_both_directions() -> None:
    forward = SessionOptions(duration_s=4.0, turns=0.3)
    scenario = Scenario(sessions=(forward, dataclasses.replace(forward, reverse=True)))
    truth = simulate(dataclasses.replace(SMALL, sessions=scenario.sessions)).truth
    angle = [
        np.unwrap(np.arctan2(*truth.T_G_I[truth.vertex_mission == m, 5:3:-1].T)) for m in (0, 1)
    ]
    assert angle[0][-1] > angle[0][0]
    assert angle[1][-1] < angle[1][0]


def test_a_session_alone_is_that_of_the_whole_scenario() -> None:
    data = simulated()
    simulator = SessionSimulator(SMALL)
    for number in (1, 0):  # in any order
        session = simulator.session(number)
        assert _tables(session.vi_map) == _tables(data.maps[number])
        rows = data.truth.vertex_mission == number
        np.testing.assert_array_equal(session.truth.T_G_I, data.truth.T_G_I[rows])


class RecordingConsole:
    def __init__(self) -> None:
        self.data = simulated()
        self.lines: list[str] = []

    @property
    def vi_map(self) -> VIMap:
        return self.data.maps[0]

    def simulate(self, _: Scenario) -> SimulatedData:
        return self.data

    def run(self, line: str) -> float:
        self.lines.append(line)
        return 1.0


def test_the_usual_commands_are_run_in_order(tmp_path: Path) -> None:
    console = RecordingConsole()
    report = demo.demonstrate(console, Scenario(), tmp_path / "my demo", overwrite=False)
    first = report.missions[0].mission
    load, *workflow = console.lines
    assert load.startswith("load_merge_all_maps --maps_folder=")
    assert workflow == [
        "evaluate_landmark_quality",
        "optimize_visual_inertial",
        f"set_mission_baseframe_to_known --map_mission={first}",
        "anchor_all_missions",
        "relax",
        "loopclosure_all_missions",
        "optimize_visual_inertial",
        f"save --map_folder='{tmp_path}/my demo'",
    ]
    shown = [step.command for step in report.steps]
    assert shown == ["simulate", "load_merge_all_maps --target_map_key=demo", *workflow]


def test_a_map_that_stays_as_it_was_has_missed_the_goal(tmp_path: Path) -> None:
    report = demo.demonstrate(RecordingConsole(), Scenario(), tmp_path, overwrite=True)
    assert report.ate_after_m == report.ate_before_m > 0.0
    assert "initial error" in report.failure or "wrongly anchored" in report.failure
