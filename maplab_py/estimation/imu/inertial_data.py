"""Validated inertial samples of many edges, with the calibrations of the IMUs."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maplab_py.array_types import F64, I64
from maplab_py.errors import MapError
from maplab_py.estimation.kernels.imu import EdgeSamples
from maplab_py.geometry import se3, so3
from maplab_py.sensors import Imu
from maplab_py.vimap import VIMap, ragged_rows, starts_of_counts, tables, to_hex

_NEAR_S = 0.01
"""Samples so near a vertex tell how its motion changes while an image is read."""


@dataclasses.dataclass(frozen=True, eq=False)
class InertialData:
    """Samples of E edges. An edge without an interval (fewer than two samples) lasts 0 s.

    Raises:
        MapError: Times of an edge run backwards, or a sample is not a number.
    """

    sample_start: I64  # (E + 1,) offsets
    timestamp_ns: I64  # (N,)
    accel_gyro: F64  # (N, 6) [ax ay az gx gy gz], m/s^2 and rad/s, as measured
    imus: tuple[Imu, ...]
    imu_of_edge: I64  # (E,) rows of imus
    edge_id: NDArray[np.uint64] | None = None  # (E, 2), for messages

    def __post_init__(self) -> None:
        step = np.diff(self.timestamp_ns)
        last = self.sample_start[1:-1] - 1  # the step from one edge's last sample to the next edge
        step[last[(last >= 0) & (last < len(step))]] = 0
        backwards = np.flatnonzero(step < 0)
        if len(backwards):
            at = int(backwards[0])
            raise MapError(
                f"{self._edge_name(at)}: the time of sample {at - self._first_sample(at) + 1} is "
                f"{-int(step[at])} ns before the one before it"
            )
        bad = np.flatnonzero(~np.isfinite(self.accel_gyro).all(axis=1))
        if len(bad):
            at = int(bad[0])
            raise MapError(
                f"{self._edge_name(at)}: sample {at - self._first_sample(at)} is not a number"
            )

    @classmethod
    def of_map(cls, vi_map: VIMap, edges: NDArray[np.int64] | None = None) -> InertialData:
        """Take the samples of some IMU edges (rows, None = all) of a map.

        Raises:
            MapError: A mission with IMU edges has no IMU, or the samples are bad.
        """
        table = vi_map.imu_edges
        rows = np.arange(len(table)) if edges is None else np.asarray(edges, dtype=np.int64)
        samples = ragged_rows(vi_map.sample_start, rows)
        mission = vi_map.vertices.mission[table.from_vertex[rows]]
        sensor_id = vi_map.missions.sensor_id[mission, tables.MissionSensor.IMU]
        ids, imu_of_edge = np.unique(sensor_id, axis=0, return_inverse=True)
        return cls(
            sample_start=starts_of_counts(table.sample_count[rows]),
            timestamp_ns=vi_map.imu_samples.timestamp_ns[samples],
            accel_gyro=vi_map.imu_samples.accel_gyro[samples],
            imus=tuple(vi_map.sensors.imu(to_hex(sensor_id)) for sensor_id in ids),
            imu_of_edge=np.asarray(imu_of_edge, dtype=np.int64).reshape(-1),
            edge_id=table.id[rows],
        )

    @classmethod
    def of_samples(cls, imu: Imu, edges: Sequence[tuple[I64, F64]]) -> InertialData:
        """Take times (S,) and samples (S, 6) of each of some edges of an IMU.

        Raises:
            MapError: The samples are bad.
        """
        none = np.zeros(0, dtype=np.int64), np.zeros((0, 6))
        times_ns, samples = (np.concatenate(c) for c in zip(none, *edges, strict=True))
        return cls(
            sample_start=starts_of_counts(np.array([len(t) for t, _ in edges], dtype=np.int64)),
            timestamp_ns=times_ns,
            accel_gyro=samples,
            imus=(imu,),
            imu_of_edge=np.zeros(len(edges), dtype=np.int64),
        )

    def __len__(self) -> int:
        return len(self.sample_start) - 1

    def with_biases(self, gyro_bias: ArrayLike, accel_bias: ArrayLike) -> EdgeSamples:
        """Return the kernels' arguments, with biases (E, 3) or (3,) [rad/s, m/s^2]."""
        shape = (len(self), 3)
        return EdgeSamples(
            self.sample_start,
            self.timestamp_ns,
            self.accel_gyro,
            np.array(np.broadcast_to(gyro_bias, shape), dtype=np.float64, order="C"),
            np.array(np.broadcast_to(accel_bias, shape), dtype=np.float64, order="C"),
            self.imu_of_edge,
            *self.corrections,
        )

    def of_edges(self, rows: I64) -> InertialData:
        """Return the samples of some edges (rows, ascending)."""
        samples = ragged_rows(self.sample_start, rows)
        return InertialData(
            sample_start=starts_of_counts(np.diff(self.sample_start)[rows]),
            timestamp_ns=self.timestamp_ns[samples],
            accel_gyro=self.accel_gyro[samples],
            imus=self.imus,
            imu_of_edge=self.imu_of_edge[rows],
            edge_id=None if self.edge_id is None else self.edge_id[rows],
        )

    @cached_property
    def duration_s(self) -> F64:
        """Time (E,) from the first to the last sample of every edge [s]."""
        duration = np.zeros(len(self))
        full = np.flatnonzero(np.diff(self.sample_start) > 0)
        first, last = self.sample_start[full], self.sample_start[full + 1] - 1
        duration[full] = (self.timestamp_ns[last] - self.timestamp_ns[first]) * 1e-9
        return duration

    @cached_property
    def corrections(self) -> tuple[F64, F64]:
        """T_g^-1 and (T_a R_A_I)^-1 of every IMU, (K, 3, 3) each (Schneider 2019, eq. 7.7-7.10)."""
        gyro = np.tile(np.eye(3), (len(self.imus), 1, 1))
        accel = gyro.copy()
        for row, imu in enumerate(self.imus):
            if imu.intrinsics is not None:
                gyro[row] = np.linalg.inv(imu.intrinsics.T_g)
                accel[row] = np.linalg.inv(imu.intrinsics.T_a @ imu.intrinsics.R_A_I)
        return gyro, accel

    @cached_property
    def internal_rotation(self) -> F64:
        """R_A_I (K, 3, 3) of every IMU."""
        known = (imu.intrinsics for imu in self.imus)
        matrices = [np.eye(3) if intrinsics is None else intrinsics.R_A_I for intrinsics in known]
        return np.ascontiguousarray(np.stack(matrices)) if matrices else np.zeros((0, 3, 3))

    @cached_property
    def noise_variance_density(self) -> F64:
        """Squared densities (K, 2) of gyroscope [rad^2/s] and accelerometer [m^2/s^3] noise."""
        densities = [[imu.gyro_noise_density, imu.acc_noise_density] for imu in self.imus]
        return np.square(np.array(densities, dtype=np.float64).reshape(-1, 2))

    @cached_property
    def walk_variance_density(self) -> F64:
        """Squared densities (K, 2) of the random walks of gyroscope and accelerometer bias."""
        densities = [
            [imu.gyro_bias_random_walk_noise_density, imu.acc_bias_random_walk_noise_density]
            for imu in self.imus
        ]
        return np.square(np.array(densities, dtype=np.float64).reshape(-1, 2))

    def near(self, sample: I64) -> tuple[F64, F64]:
        """Return mean times (E,), from a sample of every edge on, and values (E, 6) of samples near it."""
        edge = np.repeat(np.arange(len(self)), np.diff(self.sample_start))
        away_s = 1e-9 * (self.timestamp_ns - self.timestamp_ns[sample][edge])
        steps = np.abs(np.arange(len(edge)) - sample[edge])
        weight = ((np.abs(away_s) <= _NEAR_S) | (steps <= 1)).astype(np.float64)
        columns = np.column_stack([weight, away_s, self.accel_gyro])
        columns[:, 1:] *= weight[:, None]
        sums = np.add.reduceat(columns, self.sample_start[:-1], axis=0)
        return sums[:, 1] / sums[:, 0], sums[:, 2:] / sums[:, :1]

    def _edge_of(self, sample: int) -> int:
        return int(np.searchsorted(self.sample_start, sample, side="right")) - 1

    def _first_sample(self, sample: int) -> int:
        return int(self.sample_start[self._edge_of(sample)])

    def _edge_name(self, sample: int) -> str:
        edge = self._edge_of(sample)
        return f"IMU edge {edge if self.edge_id is None else to_hex(self.edge_id[edge])}"


@dataclasses.dataclass(frozen=True, eq=False)
class VertexMotion:
    """Motion of V vertices by the samples near them, biases and intrinsics taken off."""

    rate_I: F64  # (V, 3) angular velocity [rad/s]
    rate_change_I: F64  # (V, 3) angular acceleration [rad/s^2]
    acceleration_G: F64  # (V, 3) [m/s^2]

    @classmethod
    def still(cls, count: int) -> VertexMotion:
        """Return vertices that stand still."""
        return cls(*np.zeros((3, count, 3)))

    def of(self, rows: NDArray[np.integer]) -> VertexMotion:
        """Return the motion of some vertices (rows)."""
        return VertexMotion(self.rate_I[rows], self.rate_change_I[rows], self.acceleration_G[rows])

    def after(self, time_s: F64, T_G_I: F64, v_G: F64) -> tuple[F64, F64]:
        """Return the poses (V, 7) and velocities (V, 6) [v_G, w_I] a time (V,) later, to second order."""
        t = time_s[:, None]
        turn = t * (self.rate_I + 0.5 * t * self.rate_change_I)
        p_G = T_G_I[:, 4:] + t * (v_G + 0.5 * t * self.acceleration_G)
        velocity = [v_G + t * self.acceleration_G, self.rate_I + t * self.rate_change_I]
        poses = se3.make(so3.multiply(T_G_I[:, :4], so3.exp(turn)), p_G)
        return poses, np.concatenate(velocity, axis=1)


def motion_at_vertices(vi_map: VIMap, vertices: NDArray[np.integer] | None = None) -> VertexMotion:
    """Return the motion of all vertices.

    Means of the samples shortly before and after a vertex give a line. Where only one edge has samples, that
    next to the vertex counts as constant; a vertex without any is taken to stand still.

    Args:
        vi_map: A map.
        vertices: Vertices whose motion is wanted, None = all; others may stand still.
    """
    count, table = len(vi_map.vertices), vi_map.imu_edges
    wanted = np.zeros(count, dtype=np.bool_)
    wanted[slice(None) if vertices is None else vertices] = True
    is_near = wanted[table.from_vertex] | wanted[table.to_vertex]
    edges = np.flatnonzero((table.sample_count > 0) & is_near)
    if not len(edges):
        return VertexMotion.still(count)
    data = InertialData.of_map(vi_map, edges)
    first, last = data.sample_start[:-1], data.sample_start[1:] - 1
    value, change = np.zeros((2, count, 6))
    time_s, mean, has_side = np.zeros((2, count)), np.zeros((2, count, 6)), np.zeros((2, count))
    sides = (last, table.to_vertex[edges]), (first, table.from_vertex[edges])
    for side, (sample, vertex) in enumerate(sides):
        time_s[side, vertex], mean[side, vertex] = data.near(sample)
        value[vertex], has_side[side, vertex] = data.accel_gyro[sample], 1.0
    step_s = time_s[1] - time_s[0]
    both = np.flatnonzero((has_side.sum(axis=0) == 2.0) & (step_s > 0.0))
    change[both] = (mean[1, both] - mean[0, both]) / step_s[both, None]
    value[both] = mean[0, both] - time_s[0, both, None] * change[both]
    imu, is_known = np.zeros(count, dtype=np.int64), has_side.max(axis=0)[:, None]
    for _, vertex in sides:
        imu[vertex] = data.imu_of_edge
    gyro, accel = (correction[imu] for correction in data.corrections)
    biases = vi_map.vertices.gyro_bias, vi_map.vertices.accel_bias
    gravity = np.array([each.gravity_magnitude_mps2 for each in data.imus])[imu]
    force_I = _times(accel, value[:, :3] - biases[1])
    acceleration_G = so3.rotate(np.asarray(vi_map.T_G_I)[:, :4], force_I)
    acceleration_G[:, 2] -= gravity
    rate_I = _times(gyro, value[:, 3:] - biases[0])
    return VertexMotion(rate_I * is_known, _times(gyro, change[:, 3:]), acceleration_G * is_known)


def _times(matrix: F64, vector: F64) -> F64:
    return np.asarray((matrix @ vector[:, :, None])[:, :, 0])
