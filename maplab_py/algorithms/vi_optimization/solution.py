"""Apply optimised states to the map of the problem."""

import numpy as np

from maplab_py.algorithms.vi_optimization import calibration_states
from maplab_py.algorithms.vi_optimization.map_problem import MapProblem
from maplab_py.algorithms.vi_optimization.options import FixedStates
from maplab_py.estimation.states import States
from maplab_py.estimation.terms import cameras, pose
from maplab_py.geometry import se3, so3
from maplab_py.sensors import SensorSet
from maplab_py.vimap import LandmarkQuality, VIMap


def apply_states(map_problem: MapProblem, states: States, options: FixedStates) -> VIMap:
    """Return the map with the new states and calibrations.

    Landmarks are transformed to the frames of the vertices that store them. Inactive landmarks move
    with their vertex.
    """
    vi_map = _with_sensors(map_problem, states)
    if not options.absolute_pose_sensor_fix_mission_baseframes:
        vi_map = _with_base_frames(vi_map, map_problem, states)
    vi_map = _with_vertices(vi_map, map_problem, states)
    if pose.SWITCH in states.blocks:
        switch, rows = states.blocks[pose.SWITCH].values[:, 0], map_problem.factors.switched_edges
        edges = vi_map.loop_closure_edges.put(rows, switch_variable=switch)
        vi_map = vi_map.replace(loop_closure_edges=edges)
    vi_map = _with_landmarks(vi_map, map_problem, states)
    return _with_landmarks_kept(map_problem, vi_map) if options.fix_landmark_positions else vi_map


def with_estimated_sensors(map_problem: MapProblem, states: States) -> SensorSet:
    """Return the map's sensors with the calibrations of the states."""
    sensors = map_problem.vi_map.sensors
    if map_problem.rig is not None and cameras.EXTRINSICS in states.blocks:
        sensors = calibration_states.with_cameras(sensors, map_problem.rig, states)
    sensors = calibration_states.with_imus(sensors, map_problem.factors.imus, states)
    sensors = calibration_states.with_wheels(sensors, map_problem.factors.wheels, states)
    return map_problem.factors.mounted.written(sensors, states)


def _with_sensors(map_problem: MapProblem, states: States) -> VIMap:
    vi_map, sensors = map_problem.vi_map, with_estimated_sensors(map_problem, states)
    return vi_map if sensors is vi_map.sensors else vi_map.replace(sensors=sensors)


def _with_base_frames(vi_map: VIMap, map_problem: MapProblem, states: States) -> VIMap:
    """Move each mission's base frame so that its first vertex keeps position and heading in M."""
    rows = map_problem.selection.vertices
    baseframe = vi_map.missions.baseframe[vi_map.vertices.mission[rows]]
    moved, first = np.unique(baseframe, return_index=True)
    T_M_I = vi_map.vertices.T_M_I[rows[first]]
    T_G_M = np.array(vi_map.baseframes.T_G_M)
    turned = so3.multiply(
        so3.multiply(states.T_G_I[first, :4], so3.inverse(T_M_I[:, :4])),
        so3.inverse(T_G_M[moved, :4]),
    )
    about_up = np.zeros((len(moved), 3))
    about_up[:, 2] = 2.0 * np.arctan2(turned[:, 2], turned[:, 3])
    q = so3.multiply(so3.exp(about_up), T_G_M[moved, :4])
    T_G_M[moved] = se3.make(q, states.T_G_I[first, 4:] - so3.rotate(q, T_M_I[:, 4:]))
    return vi_map.replace(baseframes=vi_map.baseframes.replace(T_G_M=T_G_M))


def _with_vertices(vi_map: VIMap, map_problem: MapProblem, states: States) -> VIMap:
    rows = map_problem.selection.vertices
    T_G_M = vi_map.T_G_M[vi_map.vertices.mission[rows]]
    vertices = vi_map.vertices.put(
        rows,
        T_M_I=se3.relative(T_G_M, states.T_G_I),
        v_M=so3.rotate(so3.inverse(T_G_M[:, :4]), states.v_G),
        gyro_bias=states.gyro_bias,
        accel_bias=states.accel_bias,
    )
    return vi_map.replace(vertices=vertices)


def _with_landmarks(vi_map: VIMap, map_problem: MapProblem, states: States) -> VIMap:
    selection, rejection = map_problem.selection, map_problem.rejection
    if rejection is None:
        return vi_map
    alive = rejection.used_landmarks()
    landmarks = selection.landmarks[alive]
    home = selection.rows(vi_map.landmarks.vertex[landmarks])
    p_I = se3.transform(se3.inverse(states.T_G_I[home]), states.p_G[alive])
    table = vi_map.landmarks.put(landmarks, p_I=p_I)
    bad = selection.landmarks[~alive]
    return vi_map.replace(landmarks=table.put(bad, quality=LandmarkQuality.BAD))


def _with_landmarks_kept(map_problem: MapProblem, vi_map: VIMap) -> VIMap:
    """Return the map with all landmarks at their previous positions in G."""
    T_I_G = se3.inverse(vi_map.T_G_I[vi_map.landmarks.vertex])
    p_I = se3.transform(T_I_G, map_problem.vi_map.p_G)
    return vi_map.replace(landmarks=vi_map.landmarks.replace(p_I=p_I))
