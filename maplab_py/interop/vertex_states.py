"""Table of the vertex states of a map, and maplab's two export formats.

`asl`: comma-separated poses in G and M, velocities and biases. `rpg`: TUM.
"""

import dataclasses
from itertools import chain
from pathlib import Path

import numpy as np

from maplab_py.array_types import F64, I64, NDArray
from maplab_py.distinct import distinct
from maplab_py.errors import MapError, UserError
from maplab_py.geometry import interpolation, se3
from maplab_py.interop import text_table, trajectories
from maplab_py.output_files import write_text
from maplab_py.vimap import MissionSensor, VIMap, ids, nav_state, ragged_rows

ASL_FILE, RPG_FILE = "vertex_poses_velocities_biases.csv", "stamped_traj_estimate.txt"
_ASL_HEADER = (
    "# timestamp [ns], vertex-id, mission-id, p_G_Ix [m], p_G_Iy [m], p_G_Iz [m], q_G_Iw, q_G_Ix, "
    "q_G_Iy, q_G_Iz, p_M_Ix [m], p_M_Iy [m], p_M_Iz [m], q_M_Iw, q_M_Ix, q_M_Iy, q_M_Iz, "
    "v_Mx [m/s], v_My [m/s], v_Mz [m/s], bgx [rad/s], bgy [rad/s], bgz [rad/s], bax [m/s^2], "
    "bay [m/s^2], baz [m/s^2]\n"
)


class VertexStates(nav_state.NavState):
    """States by mission, then time. S is the reference sensor, by default the IMU."""

    vertex: I64  # (N,) vertex row; the one before, for states between vertices
    T_M_S: F64  # (N, 7)
    T_G_S: F64  # (N, 7)


def vertex_states(
    vi_map: VIMap,
    *,
    missions: NDArray[np.integer] | None = None,
    reference_sensor_id: str = "",
    at_imu_times: bool = False,
) -> VertexStates:
    """Collect the states of vertices.

    Args:
        reference_sensor_id: Sensor or camera of the poses; empty = each mission's IMU.
        at_imu_times: States at every IMU sample between the vertices: cubic position (which uses
            the velocities), rotation along the great arc, velocity and biases linear.

    Raises:
        UserError: The sensor is not mounted on a mission's IMU.
    """
    rows = np.arange(len(vi_map.missions)) if missions is None else np.asarray(missions)
    parts = [_mission_states(vi_map, int(row), at_imu_times) for row in rows]
    if reference_sensor_id:
        parts = [
            _seen_from(part, _mounting(vi_map, int(row), reference_sensor_id))
            for row, part in zip(rows, parts, strict=True)
        ]
    if not parts:
        return _mission_vertices(vi_map, np.zeros(0, dtype=np.int64))
    names = [field.name for field in dataclasses.fields(VertexStates)]
    return VertexStates(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in names)
    )


def poses_at(vi_map: VIMap, mission: int, times_ns: I64) -> F64:
    """Return the poses T_M_I (N, 7) of a mission (row) between its first and its last vertex.

    With an IMU the position is cubic (which uses the velocities), else linear; the rotation is along
    the great arc. Times outside get the pose of the nearer end.
    """
    rows = np.arange(vi_map.vertex_start[mission], vi_map.vertex_start[mission + 1])
    states = _mission_vertices(vi_map, rows)
    stamps = states.time_ns
    if len(stamps) < 2 or not vi_map.missions.sensor_id[mission, MissionSensor.IMU].any():
        return interpolation.interpolate_poses(stamps, states.T_M_I, times_ns)[0]
    inside = np.clip(times_ns, stamps[0], stamps[-1])
    before = np.clip(np.searchsorted(stamps, inside, side="right") - 1, 0, len(stamps) - 2)
    T_M_I = _between(states, before, inside)
    vertex = np.searchsorted(stamps, inside)
    at_vertex = stamps[vertex] == inside
    T_M_I[at_vertex] = states.T_M_I[vertex[at_vertex]]  # to the last bit
    return T_M_I


def write_asl(vi_map: VIMap, states: VertexStates, path: Path, *, overwrite: bool = False) -> None:
    """Write maplab's comma-separated table.

    Raises:
        UserError: The file exists and `overwrite` is not set, or it cannot be written.
    """
    vertices = distinct(states.vertex)
    names = dict(zip(vertices.tolist(), ids.to_hex_list(vi_map.vertices.id[vertices]), strict=True))
    mission_names = ids.to_hex_list(vi_map.missions.id)
    order = [4, 5, 6, 3, 0, 1, 2]
    columns: list[NDArray[np.float64] | I64 | list[str]] = [
        states.time_ns,
        [names[row] for row in states.vertex.tolist()],
        [mission_names[row] for row in vi_map.vertices.mission[states.vertex].tolist()],
        states.T_G_S[:, order],
        states.T_M_S[:, order],
        states.v_M,
        states.gyro_bias,
        states.accel_bias,
    ]
    rows = text_table.format_rows("%d, %s, %s" + ", %.17g" * 23, columns)
    write_text(path, chain([_ASL_HEADER], rows), overwrite=overwrite)


def write_rpg(states: VertexStates, path: Path, *, overwrite: bool = False) -> None:
    """Write the poses T_G_S in TUM's format, all missions together in the order of time.

    Raises:
        UserError: The file exists and `overwrite` is not set, or it cannot be written.
    """
    order = np.argsort(states.time_ns, kind="stable")
    trajectory = trajectories.Trajectory(states.time_ns[order], states.T_G_S[order])
    trajectories.write_tum(trajectory, path, overwrite=overwrite)


def _mission_vertices(vi_map: VIMap, rows: I64) -> VertexStates:
    table = vi_map.vertices
    return VertexStates(
        table.timestamp_ns[rows],
        table.T_M_I[rows],
        table.v_M[rows],
        table.gyro_bias[rows],
        table.accel_bias[rows],
        vertex=rows,
        T_M_S=table.T_M_I[rows],
        T_G_S=vi_map.T_G_I[rows],
    )


def _mission_states(vi_map: VIMap, mission: int, at_imu_times: bool) -> VertexStates:
    rows = np.arange(vi_map.vertex_start[mission], vi_map.vertex_start[mission + 1])
    states = _mission_vertices(vi_map, rows)
    if not at_imu_times:
        return states
    edges = np.flatnonzero(vi_map.vertices.mission[vi_map.imu_edges.from_vertex] == mission)
    samples = ragged_rows(vi_map.sample_start, edges)
    times = distinct(vi_map.imu_samples.timestamp_ns[samples])
    stamps = states.time_ns
    if len(stamps) < 2:
        return states
    times = times[(times >= stamps[0]) & (times <= stamps[-1])]
    before = np.clip(np.searchsorted(stamps, times, side="right") - 1, 0, len(stamps) - 2)
    T_M_I = _between(states, before, times)
    gyro_bias, accel_bias, v_M = (
        interpolation.interpolate_vectors(stamps, values, times)[0]
        for values in (states.gyro_bias, states.accel_bias, states.v_M)
    )
    T_G_I = se3.compose(vi_map.T_G_M[mission], T_M_I)
    return VertexStates(
        times, T_M_I, v_M, gyro_bias, accel_bias, vertex=rows[before], T_M_S=T_M_I, T_G_S=T_G_I
    )


def _between(states: VertexStates, before: I64, times: I64) -> F64:
    """Return T_M_I between vertices: cubic Hermite position, rotation along the great arc."""
    after = before + 1
    span = (states.time_ns[after] - states.time_ns[before]) * 1e-9
    s = (times - states.time_ns[before]) * 1e-9 / span
    A, B = states.T_M_I[before], states.T_M_I[after]
    h = np.stack([2 * s**3 - 3 * s**2 + 1, s**3 - 2 * s**2 + s, 3 * s**2 - 2 * s**3, s**3 - s**2])
    h[1::2] *= span
    p = (
        h[0][:, None] * A[:, 4:]
        + h[1][:, None] * states.v_M[before]
        + h[2][:, None] * B[:, 4:]
        + h[3][:, None] * states.v_M[after]
    )
    return se3.make(interpolation.slerp(A[:, :4], B[:, :4], s), p)


def _mounting(vi_map: VIMap, mission: int, sensor_id: str) -> F64:
    imu_id = ids.to_hex(vi_map.missions.sensor_id[mission, MissionSensor.IMU])
    try:
        return vi_map.sensors.T_I_S(imu_id, sensor_id)
    except MapError as error:
        raise UserError(f"pose_export_reference_sensor_id: {error}") from error


def _seen_from(states: VertexStates, T_I_S: F64) -> VertexStates:
    return dataclasses.replace(
        states, T_M_S=se3.compose(states.T_M_S, T_I_S), T_G_S=se3.compose(states.T_G_S, T_I_S)
    )
