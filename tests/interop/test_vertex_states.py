"""Trajectory export in maplab's two formats."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import UserError
from maplab_py.geometry import se3, so3
from maplab_py.interop.trajectories import read_trajectory
from maplab_py.interop.vertex_states import vertex_states, write_asl, write_rpg
from maplab_py.vimap import ids
from tests.interop.small_map import CAMERA_ID, IMU_ID, RIG_ID, VERTICES, make_map, position


def test_states_of_all_vertices() -> None:
    vi_map = make_map()
    states = vertex_states(vi_map)
    assert np.array_equal(states.times_ns, vi_map.vertices.timestamp_ns)
    assert np.array_equal(states.T_G_S, vi_map.T_G_I)
    one = vertex_states(vi_map, missions=np.array([1]))
    assert one.vertex.tolist() == list(range(VERTICES, 2 * VERTICES))
    assert len(vertex_states(vi_map, missions=np.zeros(0, dtype=int))) == 0


def test_asl_columns(tmp_path: Path) -> None:
    vi_map = make_map()
    write_asl(vi_map, vertex_states(vi_map), tmp_path / "a.csv")
    header, *rows = (tmp_path / "a.csv").read_text().splitlines()
    assert header.split(", ")[:4] == ["# timestamp [ns]", "vertex-id", "mission-id", "p_G_Ix [m]"]
    assert len(header.split(", ")) == 26
    assert len(rows) == 2 * VERTICES
    fields = rows[7].split(", ")
    assert int(fields[0]) == vi_map.vertices.timestamp_ns[7]
    assert fields[1] == ids.to_hex(vi_map.vertices.id[7])
    assert fields[2] == ids.to_hex(vi_map.missions.id[1])
    numbers = np.array([float(text) for text in fields[3:]])
    T_G, T_M = vi_map.T_G_I[7], vi_map.vertices.T_M_I[7]
    assert np.array_equal(numbers[:7], [*T_G[4:], T_G[3], *T_G[:3]])
    assert np.array_equal(numbers[7:14], [*T_M[4:], T_M[3], *T_M[:3]])
    assert np.array_equal(numbers[14:17], vi_map.vertices.v_M[7])
    assert np.array_equal(numbers[17:20], vi_map.vertices.gyro_bias[7])
    assert np.array_equal(numbers[20:23], vi_map.vertices.accel_bias[7])


def test_rpg_is_tum(tmp_path: Path) -> None:
    vi_map = make_map()
    write_rpg(vertex_states(vi_map), tmp_path / "a.txt")
    read = read_trajectory(tmp_path / "a.txt")
    assert np.array_equal(read.times_ns, vi_map.vertices.timestamp_ns)
    assert np.max(np.abs(read.T_R_B - vi_map.T_G_I)) < 1e-15


@pytest.mark.parametrize("sensor_id", [IMU_ID, RIG_ID, CAMERA_ID])
def test_poses_of_another_sensor(sensor_id: str) -> None:
    vi_map = make_map()
    states = vertex_states(vi_map, reference_sensor_id=sensor_id)
    T_I_S = vi_map.sensors.T_I_S(IMU_ID, sensor_id)
    assert np.allclose(states.T_G_S, se3.compose(vi_map.T_G_I, T_I_S), atol=1e-14)
    expected = {IMU_ID: se3.identity(), RIG_ID: vi_map.sensors.T_B_S(RIG_ID)}
    rig = vi_map.sensors.camera_rig(RIG_ID)
    expected[CAMERA_ID] = se3.compose(vi_map.sensors.T_B_S(RIG_ID), rig.T_B_C[0])
    assert np.allclose(T_I_S, expected[sensor_id])


def test_unknown_sensor() -> None:
    with pytest.raises(UserError, match=r"pose_export_reference_sensor_id: .*no sensor with id"):
        vertex_states(make_map(), reference_sensor_id="f" * 32)


def test_states_at_imu_times_follow_the_motion() -> None:
    vi_map = make_map()
    states = vertex_states(vi_map, at_imu_times=True)
    assert len(states) == 2 * ((VERTICES - 1) * 50 + 1)
    at_vertex = np.isin(states.times_ns, vi_map.vertices.timestamp_ns)
    assert np.max(np.abs(se3.local(states.T_G_S[at_vertex], vi_map.T_G_I))) < 1e-12
    half = len(states) // 2
    t = (states.times_ns[:half] - states.times_ns[0]) * 1e-9
    assert np.max(np.abs(states.T_M_S[:half, 4:] - position(t))) < 2e-4
    q = so3.exp(np.stack([0 * t, 0.3 * t, 0 * t], axis=1))
    error = so3.log(so3.multiply(so3.inverse(q), states.T_M_S[:half, :4]))
    assert np.max(np.abs(error)) < 1e-12
