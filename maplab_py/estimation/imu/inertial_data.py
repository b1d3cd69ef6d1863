"""The inertial samples of many edges, checked, with what is known of the IMUs."""

from __future__ import annotations

import dataclasses
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maplab_py.array_types import F64, I64
from maplab_py.errors import MapError
from maplab_py.estimation.kernels.imu import EdgeSamples
from maplab_py.sensors import Imu
from maplab_py.vimap import VIMap, ragged_rows, starts_of_counts, tables, to_hex


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
        """Check times and numbers."""
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

    def __len__(self) -> int:
        return len(self.sample_start) - 1

    def with_biases(self, gyro_bias: ArrayLike, accel_bias: ArrayLike) -> EdgeSamples:
        """Return what kernels read, with biases (E, 3) or (3,) [rad/s, m/s^2]."""
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

    def _edge_of(self, sample: int) -> int:
        return int(np.searchsorted(self.sample_start, sample, side="right")) - 1

    def _first_sample(self, sample: int) -> int:
        return int(self.sample_start[self._edge_of(sample)])

    def _edge_name(self, sample: int) -> str:
        edge = self._edge_of(sample)
        return f"IMU edge {edge if self.edge_id is None else to_hex(self.edge_id[edge])}"


def angular_velocity_at_vertices(vi_map: VIMap, vertices: NDArray[np.integer] | None = None) -> F64:
    """Return the angular velocity (V, 3) in I [rad/s], biases and intrinsics taken off.

    The first sample of the edge that leaves a vertex counts, else the last of the one that arrives;
    a vertex without either is taken to stand still.

    Args:
        vertices: Vertices whose velocities are wanted, None = all; those of others may be zero.
    """
    result = np.zeros((len(vi_map.vertices), 3))
    table = vi_map.imu_edges
    wanted = np.zeros(len(result), dtype=np.bool_)
    wanted[slice(None) if vertices is None else vertices] = True
    is_near = wanted[table.from_vertex] | wanted[table.to_vertex]
    edges = np.flatnonzero((table.sample_count > 0) & is_near)
    data = InertialData.of_map(vi_map, edges)
    if not len(edges):
        return result
    gyro_corrections = data.corrections[0][data.imu_of_edge]
    last, first = data.sample_start[1:] - 1, data.sample_start[:-1]
    for vertex, sample in ((table.to_vertex[edges], last), (table.from_vertex[edges], first)):
        measured = data.accel_gyro[sample, 3:] - vi_map.vertices.gyro_bias[vertex]
        result[vertex] = np.einsum("nij,nj->ni", gyro_corrections, measured)
    return result
