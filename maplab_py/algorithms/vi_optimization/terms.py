"""The factor terms of a map: inertial, odometry, loop closures, absolute poses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.algorithms.vi_optimization.selection import Selection
from maplab_py.errors import MapError
from maplab_py.estimation.codegen.kernels import residual_kernel
from maplab_py.estimation.factor_terms import FactorTerm
from maplab_py.estimation.imu.inertial_data import InertialData
from maplab_py.estimation.imu.preintegration import integrate
from maplab_py.estimation.inertial_terms import BiasWalkTerm, InertialTerm
from maplab_py.estimation.loss import Loss
from maplab_py.estimation.pose_terms import AbsolutePoseTerm, RelativePoseTerm, whitening
from maplab_py.geometry import se3, so3
from maplab_py.progress import Progress
from maplab_py.vimap import MissionSensor, TransformationKind, VIMap
from maplab_py.vimap.ids import to_hex
from maplab_py.vimap.queries import mission_sensor_id

I64 = NDArray[np.int64]
F64 = NDArray[np.float64]


def factor_terms(
    vi_map: VIMap, selection: Selection, options: VIOptimizationOptions, progress: Progress
) -> list[FactorTerm]:
    """Return the terms that the options ask for and the map has."""
    terms: list[FactorTerm] = []
    if options.include_inertial:
        terms += _inertial(vi_map, selection, options, progress)
    for wanted, kind, name in (
        (options.include_6dof_odometry, TransformationKind.ODOMETRY, "odometry"),
        (options.include_wheel_odometry, TransformationKind.WHEEL_ODOMETRY, "wheel odometry"),
    ):
        if wanted:
            terms += _odometry(vi_map, selection, kind, name, progress)
    if options.include_loop_closure_edges:
        terms += _loop_closures(vi_map, selection, progress)
    if options.include_absolute_pose_constraints:
        terms += _absolute_poses(vi_map, selection, progress)
    return terms


def _inertial(
    vi_map: VIMap, selection: Selection, options: VIOptimizationOptions, progress: Progress
) -> list[FactorTerm]:
    from maplab_py.estimation.symbolic.sources import inertial

    table = vi_map.imu_edges
    ends = selection.row_of_vertex[[table.from_vertex, table.to_vertex]]
    edges = np.flatnonzero((ends >= 0).all(axis=0) & (table.sample_count > 1))
    data = InertialData.of_map(vi_map, edges)
    lasting = data.duration_s > 0.0
    if not lasting.all():
        edges = edges[lasting]
        data = InertialData.of_map(vi_map, edges)
    if not len(edges):
        return []
    first, second = selection.rows(table.from_vertex[edges]), selection.rows(table.to_vertex[edges])
    magnitudes = np.array([imu.gravity_magnitude_mps2 for imu in data.imus])[data.imu_of_edge]
    if options.gravity_magnitude_mps2 > 0.0:
        magnitudes = np.full(len(edges), options.gravity_magnitude_mps2)
    g_M = np.zeros((len(edges), 3))
    g_M[:, 2] = -magnitudes
    mission = vi_map.vertices.mission[table.from_vertex[edges]]
    kernel = residual_kernel("inertial", inertial, progress)
    g_G = so3.rotate(vi_map.T_G_M[mission, :4], g_M)
    walk = integrate(data, np.zeros(3), np.zeros(3))
    return [
        InertialTerm(kernel, data, first, second, g_G),
        BiasWalkTerm(first, second, walk.gyro_walk_variance, walk.accel_walk_variance),
    ]


def _odometry(
    vi_map: VIMap, selection: Selection, kind: TransformationKind, name: str, progress: Progress
) -> list[FactorTerm]:
    from maplab_py.estimation.symbolic.sources import relative_pose

    table = vi_map.transformation_edges
    ends = selection.row_of_vertex[[table.from_vertex, table.to_vertex]]
    edges = np.flatnonzero((ends >= 0).all(axis=0) & (table.kind == kind))
    if not len(edges):
        return []
    kernel = residual_kernel("relative_pose", relative_pose, progress)
    T_I_S = _mounting(vi_map, table.from_vertex[edges], table.sensor_id[edges])
    W = whitening(table.covariance[edges])
    measured = table.T_A_B[edges]
    first, second = ends[:, edges]
    return [RelativePoseTerm(kernel, name, first, second, T_I_S, measured, W)]


def _loop_closures(vi_map: VIMap, selection: Selection, progress: Progress) -> list[FactorTerm]:
    from maplab_py.estimation.symbolic.sources import relative_pose

    table = vi_map.loop_closure_edges
    ends = selection.row_of_vertex[[table.from_vertex, table.to_vertex]]
    edges = np.flatnonzero((ends >= 0).all(axis=0) & (table.switch_variable > 0.0))
    if not len(edges):
        return []
    kernel = residual_kernel("relative_pose", relative_pose, progress)
    W = whitening(table.covariance[edges]) * table.switch_variable[edges, None, None]
    T_I_S = np.broadcast_to(se3.identity(), (len(edges), 7))
    measured = table.T_A_B[edges]
    loss = (Loss.DCS, 3.0)
    first, second = ends[:, edges]
    return [RelativePoseTerm(kernel, "loop closure", first, second, T_I_S, measured, W, loss)]


def _absolute_poses(vi_map: VIMap, selection: Selection, progress: Progress) -> list[FactorTerm]:
    from maplab_py.estimation.symbolic.sources import absolute_pose

    table = vi_map.absolute_poses
    rows = np.flatnonzero(selection.row_of_vertex[table.vertex] >= 0)
    if not len(rows):
        return []
    kernel = residual_kernel("absolute_pose", absolute_pose, progress)
    T_I_S = _mounting(vi_map, table.vertex[rows], table.sensor_id[rows])
    vertex = selection.rows(table.vertex[rows])
    W = whitening(table.covariance[rows])
    return [AbsolutePoseTerm(kernel, vertex, T_I_S, table.T_G_S[rows], W)]


def _mounting(vi_map: VIMap, vertices: NDArray[np.integer], sensor_ids: NDArray[np.uint64]) -> F64:
    """Return T_I_S (N, 7) of sensors, each on the IMU of its vertex' mission."""
    result = np.empty((len(vertices), 7))
    keys = np.column_stack([vi_map.vertices.mission[vertices].astype(np.uint64), sensor_ids])
    unique, inverse = np.unique(keys, axis=0, return_inverse=True)
    for row, (mission, *words) in enumerate(unique):
        imu_id = mission_sensor_id(vi_map, int(mission), MissionSensor.IMU)
        sensor_id = to_hex(np.array(words, dtype=np.uint64))
        if sensor_id not in vi_map.sensors.sensors:
            raise MapError(f"sensors.yaml has no sensor {sensor_id}, but measurements name it")
        result[inverse.reshape(-1) == row] = vi_map.sensors.T_I_S(imu_id, sensor_id)
    return result
