"""Put optimised states into the map they came from."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.vi_optimization.building import PosedProblem
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.algorithms.vi_optimization.rig_states import with_cameras, with_imus
from maplab_py.estimation.camera_terms import EXTRINSICS
from maplab_py.estimation.pose_terms import SWITCH
from maplab_py.estimation.states import States
from maplab_py.geometry import se3, so3
from maplab_py.sensors import SensorSet
from maplab_py.vimap import LandmarkQuality, VIMap

F64 = NDArray[np.float64]


def written_back(posed: PosedProblem, states: States, options: VIOptimizationOptions) -> VIMap:
    """Return the map with the new states and calibrations.

    Landmarks return to their vertices' frames; those that did not take part move with the vertex
    that stores them.
    """
    vi_map = _with_sensors(posed, states)
    if not options.absolute_pose_sensor_fix_mission_baseframes:
        vi_map = _with_base_frames(vi_map, posed, states)
    vi_map = _with_vertices(vi_map, posed, states)
    if SWITCH in states.blocks:
        edges = vi_map.loop_closure_edges
        switch = np.array(edges.switch_variable)
        switch[posed.factors.switched_edges] = states.blocks[SWITCH].values[:, 0]
        vi_map = vi_map.replace(loop_closure_edges=edges.replace(switch_variable=switch))
    vi_map = _with_landmarks(vi_map, posed, states)
    return _with_landmarks_kept(posed, vi_map) if options.fix_landmark_positions else vi_map


def with_estimated_sensors(posed: PosedProblem, states: States) -> SensorSet:
    """Return the map's sensors with the calibrations of the states."""
    sensors = posed.vi_map.sensors
    if posed.rig is not None and EXTRINSICS in states.blocks:
        sensors = with_cameras(sensors, posed.rig, states)
    sensors = with_imus(sensors, posed.factors.imus, states)
    return posed.factors.mounted.written(sensors, states)


def _with_sensors(posed: PosedProblem, states: States) -> VIMap:
    vi_map, sensors = posed.vi_map, with_estimated_sensors(posed, states)
    return vi_map if sensors is vi_map.sensors else vi_map.replace(sensors=sensors)


def _with_base_frames(vi_map: VIMap, posed: PosedProblem, states: States) -> VIMap:
    """Move each mission's base frame so that its first vertex keeps position and heading in M."""
    rows = posed.selection.vertices
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


def _with_vertices(vi_map: VIMap, posed: PosedProblem, states: States) -> VIMap:
    rows = posed.selection.vertices
    T_G_M = vi_map.T_G_M[vi_map.vertices.mission[rows]]
    columns = {
        name: np.array(getattr(vi_map.vertices, name))
        for name in ("T_M_I", "v_M", "gyro_bias", "accel_bias")
    }
    columns["T_M_I"][rows] = se3.relative(T_G_M, states.T_G_I)
    columns["v_M"][rows] = so3.rotate(so3.inverse(T_G_M[:, :4]), states.v_G)
    columns["gyro_bias"][rows] = states.gyro_bias
    columns["accel_bias"][rows] = states.accel_bias
    return vi_map.replace(vertices=vi_map.vertices.replace(**columns))


def _with_landmarks(vi_map: VIMap, posed: PosedProblem, states: States) -> VIMap:
    selection, rejection = posed.selection, posed.rejection
    if rejection is None:
        return vi_map
    p_I, quality = np.array(vi_map.landmarks.p_I), np.array(vi_map.landmarks.quality)
    alive = rejection.used_landmarks()
    landmarks = selection.landmarks[alive]
    home = selection.rows(vi_map.landmarks.vertex[landmarks])
    p_I[landmarks] = se3.transform(se3.inverse(states.T_G_I[home]), states.p_G[alive])
    quality[selection.landmarks[~alive]] = LandmarkQuality.BAD
    return vi_map.replace(landmarks=vi_map.landmarks.replace(p_I=p_I, quality=quality))


def _with_landmarks_kept(posed: PosedProblem, vi_map: VIMap) -> VIMap:
    """Return the map with all landmarks where they were in G, although vertices have moved."""
    T_I_G = se3.inverse(vi_map.T_G_I[vi_map.landmarks.vertex])
    p_I = se3.transform(T_I_G, posed.vi_map.p_G)
    return vi_map.replace(landmarks=vi_map.landmarks.replace(p_I=p_I))
