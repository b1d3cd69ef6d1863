"""A Kalman filter that estimates motion and calibration jointly: a baseline (Schneider 2019, 7.5).

Multi-state constraint Kalman filter (Mourikis and Roumeliotis, ICRA 2007) with the calibration as
constant states (Li et al., ICRA 2014): scale and misalignment of gyroscope and accelerometer, R_A_I
and the pose of the camera on the IMU; camera intrinsics are fixed, as in that paper. The filter runs
once over the vertices of a mission and uses inertial edges and tracks, but neither loop closures nor
landmarks of the map. It starts at the map's first state. Jacobians are evaluated at the first
estimates, so that position and heading remain unobservable.
"""

from __future__ import annotations

import dataclasses
import time

import numpy as np

from maplab_py.algorithms.self_calibration import calibration, device, reports
from maplab_py.algorithms.self_calibration.estimation import imu_interpolation
from maplab_py.algorithms.self_calibration.estimation.parameters import parameters_of
from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.algorithms.self_calibration.uncertainty import Uncertainty, name_directions, spectrum
from maplab_py.algorithms.vi_optimization import calibration_states
from maplab_py.array_types import F64, I64, NDArray
from maplab_py.errors import EstimationError
from maplab_py.estimation.blocks import ParameterBlocks
from maplab_py.estimation.imu import inertial_data, preintegration
from maplab_py.estimation.linear.threads import single_blas_thread
from maplab_py.estimation.states import States
from maplab_py.estimation.terms import inertial_calibration
from maplab_py.estimation.terms.cameras import EXTRINSICS, camera_blocks
from maplab_py.geometry import se3, so3
from maplab_py.progress import SILENT, Progress
from maplab_py.sensors import SensorSet
from maplab_py.vimap import VIMap
from studies.ekf_tracks import TrackResiduals, linearised, tracks_of

WINDOW = 20
"""Poses in the sliding window."""
_IMU_COLUMNS = {
    inertial_calibration.GYRO: 0,
    inertial_calibration.ACCEL: 6,
    inertial_calibration.ROTATION: 12,
}
_FIRST_CAMERA = 15
_TILT, _VELOCITY, _GYRO_BIAS, _ACCEL_BIAS = np.deg2rad(1.0), 0.3, 0.02, 0.3
"""Deviations of the state of the first vertex [rad, m/s, rad/s, m/s^2]."""
_LOSS_SCALE = 2.0
"""Scale of the Cauchy weights, as in the optimisation."""
_GATE = 10.0
"""Tracks with a residual of more deviations are rejected."""


def filter_jointly(
    vi_map: VIMap,
    options: SelfCalibrationOptions,
    *,
    missions: NDArray[np.integer] | None = None,
    progress: Progress = SILENT,
) -> JointFilter:
    """Run the filter over some missions (rows, None = all) of one device, one after the other.

    Raises:
        EstimationError: There is nothing to estimate, or the filter diverged.
        MapError: Calibrations are missing.
        UserError: The missions were recorded with different devices.
    """
    device.device_of(vi_map, missions)
    if options.imu_curvature:
        vi_map = imu_interpolation.correct_interpolation_bias(vi_map)
    rows = np.arange(len(vi_map.missions)) if missions is None else np.asarray(missions)
    result = JointFilter(vi_map, rows.astype(np.int64), options)
    with single_blas_thread():
        result.run(progress)
    if not np.isfinite(result.P).all() or not result.tracks_used:
        raise EstimationError("the filter found no track that it could use, or it diverged")
    return result


class JointFilter:
    """The filter; after `run` it has the estimate.

    States: calibration, current p theta v b_g b_a, p theta of the poses in the window.

    Attributes:
        parameters: What is estimated.
        before: The calibration at the beginning.
        blocks: The calibration.
        P: Covariance of the states.
        T_G_I: Poses (V, 7) of all vertices; filtered vertices have the filter's last estimate.
        changes: Change (k,) of the calibration after every vertex.
        tracks_used: Number of tracks that updated the filter.
        tracks_rejected: Number of tracks that failed a test.
        observations: Number of observations that were used.
        seconds: Run time.
    """

    def __init__(self, vi_map: VIMap, missions: I64, options: SelfCalibrationOptions) -> None:
        self._map, self._missions, self._options = vi_map, missions, options
        self.changes: list[F64] = []
        self.seconds = 0.0
        self._edge_to = {int(to): row for row, to in enumerate(vi_map.imu_edges.to_vertex)}
        imu_id, rig_id = device.device_of(vi_map, missions)
        self._imu = vi_map.sensors.imu(imu_id)
        self._rig = calibration_states.rig_cameras(vi_map, missions)
        self._cameras = vi_map.sensors.camera_rig(rig_id).cameras
        blocks = [
            *camera_blocks(self._rig.cameras, self._rig.timing_s[:, 0]),
            *inertial_calibration.imu_blocks((self._imu,)),
        ]
        self.before = self.blocks = ParameterBlocks(blocks)
        kept = options.estimated() - {"intrinsics", "time_offset", "line_delay"}
        if not kept:
            raise EstimationError("the filter estimates neither intrinsics nor delays of images")
        options = dataclasses.replace(options, states=",".join(sorted(kept)))
        zero = np.zeros((0, 3))
        states = States(np.zeros((0, 7)), zero, zero, zero, zero, self.blocks)
        self.parameters = parameters_of(self._rig, 1, states, options)
        self._columns = np.array(
            [
                _column(parameter.block, parameter.row, parameter.column)
                for parameter in self.parameters.each
            ]
        )
        self.size = _FIRST_CAMERA + 6 * len(self._cameras)
        self.P = np.zeros((self.size, self.size))
        self.P[self._columns, self._columns] = self.parameters.prior_sigma**2
        self.T_G_I = np.array(vi_map.T_G_I)
        self.first_T_G_I = self.T_G_I.copy()
        self.tracks_used = self.tracks_rejected = self.observations = self._count = 0
        self._square = 0.0

    def run(self, progress: Progress) -> None:
        """Run over all missions."""
        began = time.perf_counter()
        for mission in self._missions.tolist():
            vertices = np.flatnonzero(self._map.vertices.mission == mission)
            self._begin(vertices)
            for number, vertex in enumerate(vertices.tolist()):
                progress.step(number, len(vertices), "filter")
                if number:
                    self._propagate(vertex)
                self._augment(vertex)
                self._update(vertex)
                self.changes.append(self.change)
        self.seconds = time.perf_counter() - began

    def _begin(self, vertices: I64) -> None:
        """Start at the map's state of the first vertex of a mission."""
        vi_map, first = self._map, int(vertices[0])
        q_G_M = vi_map.T_G_M[vi_map.vertices.mission[first], :4]
        self.v_G = so3.rotate(q_G_M, vi_map.vertices.v_M[first])
        self.gyro_bias = np.array(vi_map.vertices.gyro_bias[first])
        self.accel_bias = np.array(vi_map.vertices.accel_bias[first])
        self.first_v_G = self.v_G
        self._now, self._window = first, list[int]()
        R_G_I = so3.to_matrix(self.T_G_I[first, :4])
        motion = np.zeros((15, 15))
        motion[3:6, 3:6] = R_G_I.T @ np.diag([_TILT**2, _TILT**2, 0.0]) @ R_G_I
        for at, sigma in ((6, _VELOCITY), (9, _GYRO_BIAS), (12, _ACCEL_BIAS)):
            motion[at : at + 3, at : at + 3] = sigma**2 * np.eye(3)
        self.P = np.block(
            [
                [self.P[: self.size, : self.size], np.zeros((self.size, 15))],
                [np.zeros((15, self.size)), motion],
            ]
        )
        self.tracks = tracks_of(vi_map, vertices, self._cameras, WINDOW)
        order = np.argsort(self.tracks.end, kind="stable")
        self._ending = dict(_groups(self.tracks.end[order], order))

    def _propagate(self, vertex: int) -> None:
        """Propagate to the next vertex along its inertial edge."""
        edge = self._edge_to.get(vertex, -1)
        if edge < 0:
            raise EstimationError("the filter needs an inertial edge between all vertices")
        data = inertial_data.InertialData.of_map(self._map, np.array([edge]))
        imu = dataclasses.replace(
            self._imu, intrinsics=inertial_calibration.intrinsics_of(self.blocks)[0]
        )
        made = preintegration.integrate(
            dataclasses.replace(data, imus=(imu,)),
            self.gyro_bias,
            self.accel_bias,
            with_intrinsics=True,
        )
        assert made.jacobian_intrinsics is not None
        duration, g_G = float(made.duration_s[0]), np.array([0.0, 0.0, -imu.gravity_magnitude_mps2])
        pose, old = self.T_G_I[self._now], self.first_T_G_I[self._now]
        v_G = self.v_G + duration * g_G + so3.rotate(pose[:4], made.dv[0])
        p_G = pose[4:] + duration * self.v_G + 0.5 * duration**2 * g_G
        p_G = p_G + so3.rotate(pose[:4], made.dp[0])
        q_G = so3.multiply(pose[:4], made.q_A_B[0])
        # Jacobians at the first estimates: the prediction before the updates of the last vertex
        R_old = so3.to_matrix(old[:4])
        moved = p_G - old[4:] - duration * self.first_v_G - 0.5 * duration**2 * g_G
        faster = v_G - self.first_v_G - duration * g_G
        F = np.eye(15)
        F[0:3, 3:6] = -so3.skew(moved) @ R_old
        F[0:3, 6:9] = duration * np.eye(3)
        F[3:6, 3:6] = so3.to_matrix(q_G).T @ R_old
        F[6:9, 3:6] = -so3.skew(faster) @ R_old
        into_G = np.zeros((9, 9))
        into_G[0:3, 0:3] = into_G[6:9, 6:9] = R_old
        into_G[3:6, 3:6] = np.eye(3)
        F[0:9, 9:12] = into_G @ made.jacobian_gyro_bias[0]
        F[0:9, 12:15] = into_G @ made.jacobian_accel_bias[0]
        by_imu = into_G @ made.jacobian_intrinsics[0]
        noise = np.zeros((15, 15))
        noise[0:9, 0:9] = into_G @ made.covariance[0] @ into_G.T
        noise[9:12, 9:12] = made.gyro_walk_variance[0] * np.eye(3)
        noise[12:15, 12:15] = made.accel_walk_variance[0] * np.eye(3)
        self._move_covariance(F, by_imu, noise)
        self.T_G_I[vertex] = self.first_T_G_I[vertex] = se3.make(q_G, p_G)
        self.v_G = self.first_v_G = v_G
        self._now = vertex

    def _move_covariance(self, F: F64, by_imu: F64, noise: F64) -> None:
        now = slice(self.size, self.size + 15)
        transition = np.zeros((15, len(self.P)))
        transition[:, now] = F
        transition[:9, :_FIRST_CAMERA] = by_imu
        rows = transition @ self.P
        square = rows @ transition.T + noise
        self.P[now, :], self.P[:, now] = rows, rows.T
        self.P[now, now] = 0.5 * (square + square.T)

    def _augment(self, vertex: int) -> None:
        """Add the current pose to the window; remove the oldest pose if the window is full."""
        copied = np.concatenate([np.arange(len(self.P)), self.size + np.arange(6)])
        self.P = self.P[np.ix_(copied, copied)]
        self._window.append(vertex)
        if len(self._window) > WINDOW:
            self._window.pop(0)
            first = self.size + 15
            kept = np.concatenate([np.arange(first), np.arange(first + 6, len(self.P))])
            self.P = self.P[np.ix_(kept, kept)]

    def _update(self, vertex: int) -> None:
        """Update with the tracks that end at this vertex; their landmarks are eliminated."""
        chosen = self._ending.get(vertex)
        if chosen is None:
            return
        T_I_C = self.blocks[EXTRINSICS].values
        residuals = linearised(
            self.tracks,
            chosen,
            self.T_G_I,
            T_I_C,
            self.first_T_G_I,
            np.deg2rad(self._options.min_parallax_deg),
        )
        square = np.sum(residuals.residual**2, axis=1)
        is_off = np.bincount(residuals.track, square > _GATE**2, minlength=len(chosen)) > 0
        good = residuals.is_good & ~is_off
        self.tracks_used += int(good.sum())
        self.tracks_rejected += int((~good).sum())
        rows = np.flatnonzero(good[residuals.track])
        if not len(rows):
            return
        weight = np.sqrt(1.0 / (1.0 + square[rows] / _LOSS_SCALE**2))[:, None, None]
        H = (
            self._state_jacobian(residuals.vertex[rows], residuals.camera[rows], residuals, rows)
            * weight
        )
        by_point, error = (
            residuals.by_point[rows] * weight,
            residuals.residual[rows] * weight[:, :, 0],
        )
        self._square += float(square[rows].sum())
        self.observations += len(rows)
        self._count += 2 * len(rows) - 3 * int(good.sum())
        self._correct(*_eliminate(H, by_point, error, residuals.track[rows]))

    def _state_jacobian(
        self, vertex: I64, camera: I64, residuals: TrackResiduals, rows: I64
    ) -> F64:
        H = np.zeros((len(rows), 2, len(self.P)))
        slot = vertex - self._window[0]
        pose = self.size + 15 + 6 * slot[:, None] + np.arange(6)
        mount = _FIRST_CAMERA + 6 * camera[:, None] + np.arange(6)
        np.put_along_axis(H, pose[:, None, :].repeat(2, 1), residuals.by_pose[rows], axis=2)
        np.put_along_axis(H, mount[:, None, :].repeat(2, 1), residuals.by_camera[rows], axis=2)
        return H

    def _correct(self, information: F64, right: F64) -> None:
        """Update with information (d, d) and its right side (d,)."""
        P = np.linalg.solve(np.eye(len(self.P)) + self.P @ information, self.P)
        self.P = 0.5 * (P + P.T)
        step = self.P @ right
        now, poses = step[self.size : self.size + 15], step[self.size + 15 :].reshape(-1, 6)
        self.T_G_I[self._window] = se3.retract(self.T_G_I[self._window], poses)
        self.v_G = self.v_G + now[6:9]
        self.gyro_bias, self.accel_bias = self.gyro_bias + now[9:12], self.accel_bias + now[12:15]
        self.blocks = _move(self.blocks, step[: self.size])

    @property
    def change(self) -> F64:
        """Change (k,) of the calibration so far."""
        return self.parameters.difference(self.blocks, self.before)

    @property
    def covariance(self) -> F64:
        """Covariance (k, k) of the calibration."""
        return np.asarray(self.P[np.ix_(self._columns, self._columns)])

    @property
    def mean_square(self) -> float:
        """Mean square of all whitened errors of observations that were used."""
        return self._square / max(self._count, 1)

    @property
    def sensors(self) -> SensorSet:
        """The map's sensors with the calibration."""
        zero = np.zeros((0, 3))
        states = States(np.zeros((0, 7)), zero, zero, zero, zero, self.blocks)
        sensors = calibration_states.with_cameras(self._map.sensors, self._rig, states)
        return calibration_states.with_imus(sensors, (self._imu,), states)

    def report(self) -> reports.SelfCalibrationReport:
        """Return the report, without costs and iterations."""
        parameters = self.parameters
        uncertainty = Uncertainty(parameters.prior_sigma, self.covariance)
        directions = spectrum(self.covariance, parameters).unobservable()
        return reports.SelfCalibrationReport(
            parameters=calibration.parameter_estimates(
                parameters, self.before, self.change, uncertainty
            ),
            unobservable=name_directions(directions, parameters),
            without_scale=(),
            segments=0,
            partitions=1,
            gaps=0,
            keyframes=len(self.changes),
            landmarks=self.tracks_used,
            observations=self.observations,
            inconsistent_landmarks=self.tracks_rejected,
            keypoint_noise_factor=uncertainty.noise_factor,  # the filter uses the map's noise
            track_deviation_factor=uncertainty.track_factor,
            cost_before=float("nan"),
            cost_after=float("nan"),
            chi_square_per_freedom=self.mean_square,
            iterations=0,
            termination=f"filtered once; {self.tracks_rejected} tracks rejected",
            seconds_pose=0.0,
            seconds_solve=self.seconds,
        )


def _column(block: str, row: int, column: int) -> int:
    """Return the index of a parameter among the states."""
    return _FIRST_CAMERA + 6 * row + column if block == EXTRINSICS else _IMU_COLUMNS[block] + column


def _move(blocks: ParameterBlocks, step: F64) -> ParameterBlocks:
    """Apply a step of the calibration states."""
    by_block = {
        inertial_calibration.GYRO: step[None, 0:6],
        inertial_calibration.ACCEL: step[None, 6:12],
        inertial_calibration.ROTATION: step[None, 12:15],
        EXTRINSICS: step[_FIRST_CAMERA:].reshape(-1, 6),
    }
    return ParameterBlocks(
        block.moved(by_block[block.name].reshape(-1, 3)) if block.name in by_block else block
        for block in blocks
    )


def _groups(values: I64, rows: I64) -> list[tuple[int, I64]]:
    """Return the rows of each distinct value of a sorted array."""
    unique, first = np.unique(values, return_index=True)
    return list(zip(unique.tolist(), np.split(rows, first[1:]), strict=True))


def _eliminate(H: F64, by_point: F64, error: F64, track: I64) -> tuple[F64, F64]:
    """Return the information (d, d) of tracks about the states and its right side; points eliminated.

    The Schur complement of a track's point is the projection on the left null space of its
    Jacobian.
    """
    size = H.shape[2]
    unique, track_row = np.unique(track, return_inverse=True)
    count = len(unique)
    points, cross = np.zeros((count, 3, 3)), np.zeros((count, 3, size + 1))
    np.add.at(points, track_row, by_point.transpose(0, 2, 1) @ by_point)
    right = np.concatenate([H, error[:, :, None]], axis=2)
    np.add.at(cross, track_row, by_point.transpose(0, 2, 1) @ right)
    flat, flat_cross = right.reshape(-1, size + 1), cross.reshape(-1, size + 1)
    solved = np.linalg.solve(points, cross).reshape(-1, size + 1)
    reduced = flat.T @ flat - flat_cross.T @ solved
    return reduced[:size, :size], reduced[:size, size]
