"""Factor terms of a map: inertial, odometry, loop closures, absolute poses."""

import dataclasses

import numpy as np

from maplab_py.algorithms.vi_optimization.calibration_states import MountedSensors
from maplab_py.algorithms.vi_optimization.data_selection import Selection
from maplab_py.algorithms.vi_optimization.options import (
    DataOptions,
    PriorOptions,
    VIOptimizationOptions,
)
from maplab_py.array_types import F64, I64, U64, Mask, NDArray
from maplab_py.errors import MapError
from maplab_py.estimation.codegen.kernels import residual_kernel
from maplab_py.estimation.imu.inertial_data import InertialData
from maplab_py.estimation.loss import Loss
from maplab_py.estimation.states import ACCEL_BIAS, GYRO_BIAS, States
from maplab_py.estimation.terms import inertial_calibration, pose, protocol, wheel
from maplab_py.estimation.terms.inertial import BiasWalkTerm, InertialTerm
from maplab_py.estimation.terms.prior import BlockPrior, PosePrior, VertexVectorPrior
from maplab_py.geometry import se3, so3, symmetric
from maplab_py.progress import Progress
from maplab_py.sensors import Imu
from maplab_py.sensors.imu import gravity_mps2
from maplab_py.sensors.wheels import wheel_scale
from maplab_py.vimap import MissionSensor, TransformationKind, VIMap, from_hex, queries, to_hex

# The difference between measured and estimated positions changes slowly, by the drift of the trajectory;
# a measurement that differs from the local median of the differences is wrong. So a trajectory may
# be tens of metres off while single measurements are judged by their own deviation.

_WINDOW = 31
"""Neighbouring measurements whose median counts; up to half of them may be wrong."""
_MIN_MEASUREMENTS = 5
_LEAST_VARIANCE_M2 = 1e-12
_MEDIAN_CHI = 1.538
"""Median of the norm of three standard normal variables."""


def absolute_outliers(vi_map: VIMap, rows: I64, T_I_S: F64, gate_sigma: float) -> Mask:
    """Return which absolute poses (rows of the table, N) have outlying positions (N,).

    Deviations count by the covariances, scaled up where most measurements are worse than these say.

    Args:
        vi_map: Map with the initial states.
        rows: Rows of `absolute_poses`.
        T_I_S: Extrinsics (N, 7) of their sensors.
        gate_sigma: Largest deviation of an inlier, in standard deviations; 0 = all are inliers.
    """
    result = np.zeros(len(rows), dtype=np.bool_)
    if gate_sigma <= 0.0 or not len(rows):
        return result
    table = vi_map.absolute_poses.take(rows)
    p_G = se3.compose(vi_map.T_G_I[table.vertex], T_I_S)[:, 4:]
    difference_m = table.T_G_S[:, 4:] - p_G
    mission = vi_map.vertices.mission[table.vertex].astype(np.uint64)
    keys = np.column_stack([mission, table.sensor_id])
    _, group = np.unique(keys, axis=0, return_inverse=True)
    for number in range(int(group.max()) + 1):
        members = np.flatnonzero(group.reshape(-1) == number)
        members = members[np.argsort(table.timestamp_ns[members], kind="stable")]
        if len(members) >= _MIN_MEASUREMENTS:
            deviation = _deviations(difference_m[members], table.covariance[members, :3, :3])
            unit = max(1.0, float(np.median(deviation)) / _MEDIAN_CHI)
            result[members] = deviation > gate_sigma * unit
    return result


def _deviations(difference_m: F64, covariance: F64) -> F64:
    """Return the deviations (N,) from the local median, in standard deviations."""
    from scipy.ndimage import median_filter

    window = min(_WINDOW, len(difference_m) - 1 + len(difference_m) % 2)
    # mirrored, the first and the last measurement count once among their neighbours
    away = difference_m - median_filter(difference_m, size=(window, 1), mode="mirror")
    usable = np.isfinite(covariance).all(axis=(1, 2), keepdims=True)
    information = symmetric.inverse(np.where(usable, covariance, np.eye(3)), _LEAST_VARIANCE_M2)
    squared = np.einsum("ni,nij,nj->n", away, information, away)
    return np.asarray(np.sqrt(np.maximum(squared, 0.0)))


@dataclasses.dataclass(frozen=True, eq=False)
class MapFactors:
    """Factor terms of a map, the states with their parameter blocks, and the sensors of the blocks."""

    terms: list[protocol.FactorTerm]
    states: States
    imus: tuple[Imu, ...] = ()  # rows of the IMU blocks
    mounted: MountedSensors = dataclasses.field(default_factory=MountedSensors)
    wheels: tuple[str, ...] = ()  # ids of the rows of the block of wheel scales
    switched_edges: I64 = dataclasses.field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    absolute_poses_rejected: int = 0  # outliers that are left out


def factor_terms(
    vi_map: VIMap,
    selection: Selection,
    options: VIOptimizationOptions,
    states: States,
    progress: Progress,
) -> MapFactors:
    """Return the terms that the options enable and the map has measurements for."""
    result = MapFactors([], states)
    if options.include_inertial:
        result = _with_inertial(result, vi_map, selection, options, progress)
    result = _with_mountings(result, vi_map, selection, options)
    if options.include_wheel_odometry and not options.fix_wheel_scale:
        result = _with_wheel_scales(result, vi_map, selection)
    for wanted, kind, name, is_fixed in (
        (
            options.include_6dof_odometry,
            TransformationKind.ODOMETRY,
            "odometry",
            options.fix_6dof_odometry_extrinsics,
        ),
        (
            options.include_wheel_odometry,
            TransformationKind.WHEEL_ODOMETRY,
            "wheel odometry",
            options.fix_wheel_odometry_extrinsics,
        ),
    ):
        if wanted:
            result.terms.extend(
                _odometry(result, vi_map, selection, kind, name, is_fixed, progress)
            )
    if options.include_absolute_pose_constraints:
        result = _with_absolute_poses(result, vi_map, selection, options, progress)
    if options.include_loop_closure_edges:
        result = _with_loop_closures(result, vi_map, selection, options, progress)
    return result


def prior_terms(states: States, options: PriorOptions) -> list[protocol.FactorTerm]:
    """Return the enabled priors of poses and biases at the given states."""
    vertices, terms = np.arange(len(states.T_G_I)), list[protocol.FactorTerm]()
    sigmas = [options.position_prior_sigma_m] * 3 + [options.orientation_prior_sigma_rad] * 3
    if any(sigmas):
        root = np.diag([1.0 / sigma if sigma > 0.0 else 0.0 for sigma in sigmas])
        terms.append(PosePrior(vertices, states.T_G_I, root))
    for kind, values, sigma in (
        (GYRO_BIAS, states.gyro_bias, options.gyro_bias_prior_sigma_radps),
        (ACCEL_BIAS, states.accel_bias, options.accel_bias_prior_sigma_mps2),
    ):
        if sigma > 0.0:
            terms.append(VertexVectorPrior(kind, vertices, values, sigma))
    return terms


def landmark_prior(states: States, options: PriorOptions) -> F64 | None:
    """Return the prior (L, 4) of the landmarks at the given states, if it is enabled."""
    sigma_m = options.landmark_prior_sigma_m
    if not sigma_m > 0.0:
        return None
    return np.column_stack([states.p_G, np.full(len(states.p_G), 1.0 / sigma_m)])


def _with_inertial(
    so_far: MapFactors,
    vi_map: VIMap,
    selection: Selection,
    options: VIOptimizationOptions,
    progress: Progress,
) -> MapFactors:
    from maplab_py.estimation.symbolic.sources import inertial, inertial_with_intrinsics

    table = vi_map.imu_edges
    ends = selection.row_of_vertex[[table.from_vertex, table.to_vertex]]
    edges = np.flatnonzero((ends >= 0).all(axis=0) & (table.sample_count > 1))
    data = InertialData.of_map(vi_map, edges)
    lasting = data.duration_s > 0.0
    if not lasting.all():
        edges = edges[lasting]
        data = InertialData.of_map(vi_map, edges)
    if not len(edges):
        return so_far
    first, second = selection.rows(table.from_vertex[edges]), selection.rows(table.to_vertex[edges])
    mission = vi_map.vertices.mission[table.from_vertex[edges]]
    g_G = so3.rotate(vi_map.T_G_M[mission, :4], _gravity_M(data, options))
    walk = data.walk_variance_density[data.imu_of_edge] * data.duration_s[:, None]
    bias_walk = BiasWalkTerm(first, second, walk[:, 0], walk[:, 1])
    if options.fix_imu_intrinsics:
        kernel = residual_kernel("inertial", inertial, progress)
        plain = InertialTerm(kernel, data, first, second, g_G)
        return dataclasses.replace(so_far, terms=[*so_far.terms, plain, bias_walk])
    kernel = residual_kernel("inertial_with_intrinsics", inertial_with_intrinsics, progress)
    states = so_far.states.with_blocks(*inertial_calibration.imu_blocks(data.imus))
    term = inertial_calibration.CalibratingInertialTerm(kernel, data, first, second, g_G, states)
    return dataclasses.replace(
        so_far, terms=[*so_far.terms, term, bias_walk], states=states, imus=data.imus
    )


def _gravity_M(data: InertialData, options: DataOptions) -> F64:
    """Return gravity (E, 3) in the mission frames, from the map or from the flags."""
    magnitudes = np.array([imu.gravity_magnitude_mps2 for imu in data.imus])[data.imu_of_edge]
    if not np.isnan(options.latitude):
        magnitudes = np.full(len(data), gravity_mps2(options.latitude, options.altitude_meters))
    if options.gravity_magnitude_mps2 > 0.0:
        magnitudes = np.full(len(data), options.gravity_magnitude_mps2)
    return np.stack([np.zeros(len(data)), np.zeros(len(data)), -magnitudes], axis=1)


def _with_mountings(
    so_far: MapFactors, vi_map: VIMap, selection: Selection, options: VIOptimizationOptions
) -> MapFactors:
    """Add an extrinsics block for every sensor whose extrinsics are estimated."""
    keys = [np.zeros((0, 3), dtype=np.uint64)]
    table, absolute = vi_map.transformation_edges, vi_map.absolute_poses
    for kind, is_free in (
        (
            TransformationKind.ODOMETRY,
            options.include_6dof_odometry and not options.fix_6dof_odometry_extrinsics,
        ),
        (
            TransformationKind.WHEEL_ODOMETRY,
            options.include_wheel_odometry and not options.fix_wheel_odometry_extrinsics,
        ),
    ):
        rows = _edges_of(vi_map, selection, kind) if is_free else np.zeros(0, dtype=np.int64)
        keys.append(_sensor_keys(vi_map, table.from_vertex[rows], table.sensor_id[rows]))
    if options.include_absolute_pose_constraints and not (
        options.fix_absolute_pose_sensor_extrinsics
    ):
        rows = np.flatnonzero(selection.row_of_vertex[absolute.vertex] >= 0)
        keys.append(_sensor_keys(vi_map, absolute.vertex[rows], absolute.sensor_id[rows]))
    owners = sorted({_owner(vi_map, key) for key in np.unique(np.concatenate(keys), axis=0)})
    if not owners:
        return so_far
    T_I_S = np.stack([vi_map.sensors.T_I_S(*owner) for owner in owners])
    states = so_far.states.with_blocks(pose.mounting_block(T_I_S))
    return dataclasses.replace(so_far, states=states, mounted=MountedSensors(tuple(owners)))


def _with_wheel_scales(so_far: MapFactors, vi_map: VIMap, selection: Selection) -> MapFactors:
    """Add a block with the scale of every wheel sensor."""
    rows = _edges_of(vi_map, selection, TransformationKind.WHEEL_ODOMETRY)
    words = np.unique(vi_map.transformation_edges.sensor_id[rows], axis=0)
    wheels = tuple(to_hex(row) for row in words)
    if not wheels:
        return so_far
    scales = np.array([wheel_scale(vi_map.sensors, sensor_id) for sensor_id in wheels])
    states = so_far.states.with_blocks(wheel.wheel_scale_block(scales))
    return dataclasses.replace(so_far, states=states, wheels=wheels)


def _edges_of(vi_map: VIMap, selection: Selection, kind: TransformationKind) -> I64:
    """Return the edges (rows) of a kind between selected vertices."""
    table = vi_map.transformation_edges
    ends = selection.row_of_vertex[[table.from_vertex, table.to_vertex]]
    return np.flatnonzero((ends >= 0).all(axis=0) & (table.kind == kind))


def _odometry(
    so_far: MapFactors,
    vi_map: VIMap,
    selection: Selection,
    kind: TransformationKind,
    name: str,
    is_fixed: bool,
    progress: Progress,
) -> list[protocol.FactorTerm]:
    from maplab_py.estimation.symbolic import sources

    table = vi_map.transformation_edges
    edges = _edges_of(vi_map, selection, kind)
    if not len(edges):
        return []
    T_I_S, rows = _mounting(
        vi_map, so_far.mounted, table.from_vertex[edges], table.sensor_id[edges]
    )
    W, measured = pose.whitening(table.covariance[edges]), np.array(table.T_A_B[edges])
    first = selection.rows(table.from_vertex[edges])
    second = selection.rows(table.to_vertex[edges])
    has_scale = kind == TransformationKind.WHEEL_ODOMETRY and bool(so_far.wheels)
    if kind == TransformationKind.WHEEL_ODOMETRY and not has_scale:
        measured, W = _unscaled(vi_map, table.sensor_id[edges], measured, W)
    kernel_name = f"{'scaled_' if has_scale else ''}relative_pose"
    kernel_name += "" if is_fixed else "_with_mounting"
    kernel = residual_kernel(kernel_name, getattr(sources, kernel_name), progress)
    mounting = None if is_fixed else pose.Mounting.of(so_far.states, rows)
    term = pose.RelativePoseTerm(kernel, name, first, second, T_I_S, measured, W, mounting=mounting)
    if not has_scale:
        return [term]
    wheels = np.stack([from_hex(sensor_id) for sensor_id in so_far.wheels])
    sensor = np.argmax((table.sensor_id[edges][:, None] == wheels).all(axis=2), axis=1)
    return [
        wheel.ScaledRelativePoseTerm(term, sensor, so_far.states.nodes(wheel.WHEEL_SCALE)[sensor])
    ]


def _unscaled(vi_map: VIMap, sensor_id: U64, measured: F64, W: F64) -> tuple[F64, F64]:
    """Return measurements (N, 7) of wheels with true distances, and their whitening (N, 6, 6)."""
    words, row = np.unique(sensor_id, axis=0, return_inverse=True)
    scales = np.array([wheel_scale(vi_map.sensors, to_hex(word)) for word in words])
    if np.all(scales == 1.0):
        return measured, W
    scale = scales[row.reshape(-1), None]
    measured[:, 4:] /= scale
    return measured, np.concatenate([W[:, :, :3] * scale[:, None], W[:, :, 3:]], axis=2)


def _with_loop_closures(
    so_far: MapFactors,
    vi_map: VIMap,
    selection: Selection,
    options: VIOptimizationOptions,
    progress: Progress,
) -> MapFactors:
    from maplab_py.estimation.symbolic.sources import relative_pose, switched_relative_pose

    table = vi_map.loop_closure_edges
    is_switched = options.loop_closure_robustness == "switchable"
    ends = selection.row_of_vertex[[table.from_vertex, table.to_vertex]]
    edges = np.flatnonzero((ends >= 0).all(axis=0) & ((table.switch_variable > 0.0) | is_switched))
    if not len(edges):
        return so_far
    measured, (first, second) = table.T_A_B[edges], ends[:, edges]
    W = pose.whitening(table.covariance[edges])
    if is_switched:
        kernel = residual_kernel("switched_relative_pose", switched_relative_pose, progress)
        states = so_far.states.with_blocks(pose.switch_block(np.ones(len(edges))))
        rows, nodes = np.arange(len(edges)), states.nodes(pose.SWITCH)
        term = pose.SwitchedRelativePoseTerm(
            kernel, "loop closure", first, second, measured, W, rows, nodes
        )
        sigma = np.sqrt(np.maximum(table.switch_variable_variance[edges], 1e-16))
        prior = BlockPrior(
            states, pose.SWITCH, np.ones((len(edges), 1)), 1.0 / sigma[:, None, None]
        )
        terms = [*so_far.terms, term, prior]
        return dataclasses.replace(so_far, terms=terms, states=states, switched_edges=edges)
    kernel = residual_kernel("relative_pose", relative_pose, progress)
    W = W * table.switch_variable[edges, None, None]
    T_I_S = np.broadcast_to(se3.identity(), (len(edges), 7))
    loss = (Loss.DCS, 3.0) if options.loop_closure_robustness == "dcs" else (Loss.NONE, 1.0)
    plain = pose.RelativePoseTerm(kernel, "loop closure", first, second, T_I_S, measured, W, loss)
    return dataclasses.replace(so_far, terms=[*so_far.terms, plain])


def _with_absolute_poses(
    so_far: MapFactors,
    vi_map: VIMap,
    selection: Selection,
    options: VIOptimizationOptions,
    progress: Progress,
) -> MapFactors:
    """Add the absolute poses except outliers."""
    from maplab_py.estimation.symbolic.sources import absolute_pose, absolute_pose_with_mounting

    table = vi_map.absolute_poses
    rows = np.flatnonzero(selection.row_of_vertex[table.vertex] >= 0)
    if not len(rows):
        return so_far
    T_I_S, mounted = _mounting(vi_map, so_far.mounted, table.vertex[rows], table.sensor_id[rows])
    outlying = absolute_outliers(vi_map, rows, T_I_S, options.absolute_pose_gate_sigma)
    T_I_S, mounted, used = T_I_S[~outlying], mounted[~outlying], rows[~outlying]
    vertex = selection.rows(table.vertex[used])
    W = pose.whitening(table.covariance[used])
    scale = options.absolute_pose_loss_scale
    loss = (Loss.HUBER, scale) if scale > 0.0 else (Loss.NONE, 1.0)
    mounting = None
    if options.fix_absolute_pose_sensor_extrinsics:
        kernel = residual_kernel("absolute_pose", absolute_pose, progress)
    else:
        name = "absolute_pose_with_mounting"
        kernel = residual_kernel(name, absolute_pose_with_mounting, progress)
        mounting = pose.Mounting.of(so_far.states, mounted)
    term = pose.AbsolutePoseTerm(
        kernel, vertex, T_I_S, table.T_G_S[used], W, loss=loss, mounting=mounting
    )
    return dataclasses.replace(
        so_far,
        terms=[*so_far.terms, term],
        absolute_poses_rejected=int(np.count_nonzero(outlying)),
    )


def _sensor_keys(
    vi_map: VIMap, vertices: NDArray[np.integer], sensor_ids: NDArray[np.uint64]
) -> NDArray[np.uint64]:
    mission = vi_map.vertices.mission[vertices].astype(np.uint64)
    return np.column_stack([mission, sensor_ids])


def _owner(vi_map: VIMap, key: NDArray[np.uint64]) -> tuple[str, str]:
    """Return the ids of the mission's IMU and of the sensor of a key [mission, id words]."""
    imu_id = queries.mission_sensor_id(vi_map, int(key[0]), MissionSensor.IMU)
    sensor_id = to_hex(key[1:])
    if sensor_id not in vi_map.sensors.sensors:
        raise MapError(f"sensors.yaml has no sensor {sensor_id}, but measurements name it")
    return imu_id, sensor_id


def _mounting(
    vi_map: VIMap,
    mounted: MountedSensors,
    vertices: NDArray[np.integer],
    sensor_ids: NDArray[np.uint64],
) -> tuple[F64, I64]:
    """Return T_I_S (N, 7) of sensors and their rows (N,) of the mounting block (-1 = none)."""
    result, row = np.empty((len(vertices), 7)), np.full(len(vertices), -1, dtype=np.int64)
    keys = _sensor_keys(vi_map, vertices, sensor_ids)
    unique, inverse = np.unique(keys, axis=0, return_inverse=True)
    for number, key in enumerate(unique):
        owner = _owner(vi_map, key)
        of_owner = inverse.reshape(-1) == number
        # a mission without IMU has the last base of its sensors as body
        imu_id, sensor_id = owner
        sensors = vi_map.sensors
        result[of_owner] = sensors.T_I_S(*owner) if imu_id else sensors.T_R_S(sensor_id)
        row[of_owner] = mounted.owner.index(owner) if owner in mounted.owner else -1
    return result, row
