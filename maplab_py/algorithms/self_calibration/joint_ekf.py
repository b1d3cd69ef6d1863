"""A Kalman filter that estimates motion and calibration together: a baseline (thesis section 7.5).

Multi-state constraint Kalman filter (Mourikis and Roumeliotis, ICRA 2007) with the calibration as
constant states (Li et al., ICRA 2014): scale and misalignment of gyroscope and accelerometer, R_A_I
and the camera's pose on the IMU; camera intrinsics are held, as in the thesis. It runs once over the
vertices of a mission and sees what a filter would: inertial edges and tracks, no loop closures, no
landmark of the map. It begins at the map's first state. Derivatives are taken at the first
estimates, so that position and heading stay unobservable.
"""

from __future__ import annotations

import dataclasses
import time

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.self_calibration.curvature import with_curvature
from maplab_py.algorithms.self_calibration.database import device_of
from maplab_py.algorithms.self_calibration.ekf_tracks import TrackResiduals, linearised, tracks_of
from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.algorithms.self_calibration.parameters import Parameters, parameters_of
from maplab_py.algorithms.vi_optimization.rig_states import rig_cameras, with_cameras, with_imus
from maplab_py.errors import EstimationError
from maplab_py.estimation.blocks import ParameterBlocks
from maplab_py.estimation.camera_terms import EXTRINSICS, camera_blocks
from maplab_py.estimation.imu.inertial_data import InertialData
from maplab_py.estimation.imu.preintegration import integrate
from maplab_py.estimation.imu_calibration_terms import (
    ACCEL,
    GYRO,
    ROTATION,
    imu_blocks,
    intrinsics_of,
)
from maplab_py.estimation.linear.threads import single_blas_thread
from maplab_py.estimation.states import States
from maplab_py.geometry import se3, so3
from maplab_py.progress import SILENT, Progress
from maplab_py.sensors import SensorSet
from maplab_py.vimap import VIMap

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

WINDOW = 20
"""Poses that the filter remembers."""
_IMU_COLUMNS = {GYRO: 0, ACCEL: 6, ROTATION: 12}
_FIRST_CAMERA = 15
_TILT, _VELOCITY, _GYRO_BIAS, _ACCEL_BIAS = np.deg2rad(1.0), 0.3, 0.02, 0.3
"""Deviations of the state of the first vertex [rad, m/s, rad/s, m/s^2]."""
_LOSS_SCALE = 2.0
"""Of the Cauchy weights, as in the optimisation."""
_GATE = 10.0
"""Tracks with an observation off by more deviations are left out."""


@dataclasses.dataclass(frozen=True, eq=False)
class FilteredCalibration:
    """What the filter knows at the end, and on the way."""

    sensors: SensorSet
    parameters: Parameters
    before: ParameterBlocks
    blocks: ParameterBlocks
    covariance: F64  # (k, k)
    history: F64  # (V, k) change from before, after every vertex
    T_G_I: F64  # (V, 7) poses of all vertices; of those filtered as the filter left them
    tracks: int  # that were used
    tracks_rejected: int
    observations: int  # that were used
    mean_square: float  # of all whitened errors of observations that were used
    seconds: float

    @property
    def change(self) -> F64:
        """Tangent vector (k,) that leads from the calibration before."""
        return self.parameters.difference(self.blocks, self.before)


def filter_jointly(
    vi_map: VIMap,
    options: SelfCalibrationOptions,
    *,
    missions: NDArray[np.integer] | None = None,
    progress: Progress = SILENT,
) -> FilteredCalibration:
    """Filter some missions (rows, None = all) of one device one after the other.

    Raises:
        EstimationError: There is nothing to estimate, or the filter diverged.
        MapError: Calibrations are missing.
        UserError: The missions were recorded with different devices.
    """
    began = time.perf_counter()
    device_of(vi_map, missions)
    if options.imu_curvature:
        vi_map = with_curvature(vi_map)
    rows = np.arange(len(vi_map.missions)) if missions is None else np.asarray(missions)
    runner = _Filter(vi_map, rows.astype(np.int64), options)
    history = []
    with single_blas_thread():
        for mission in rows.tolist():
            vertices = np.flatnonzero(vi_map.vertices.mission == mission)
            runner.begin(vertices)
            for number, vertex in enumerate(vertices.tolist()):
                progress.step(number, len(vertices), "filter")
                if number:
                    runner.propagate(vertex)
                runner.remember(vertex)
                runner.update(vertex)
                history.append(runner.change())
    if not np.isfinite(runner.P).all() or not runner.used:
        raise EstimationError("the filter found no track that it could use, or it diverged")
    return runner.result(np.array(history), time.perf_counter() - began)


class _Filter:
    """States: calibration, then p theta v b_g b_a of now, then p theta of the window."""

    def __init__(self, vi_map: VIMap, missions: I64, options: SelfCalibrationOptions) -> None:
        self._map, self._options = vi_map, options
        self._edge_to = {int(to): row for row, to in enumerate(vi_map.imu_edges.to_vertex)}
        imu_id, rig_id = device_of(vi_map, missions)
        self._imu = vi_map.sensors.imu(imu_id)
        self._rig = rig_cameras(vi_map, missions)
        self._cameras = vi_map.sensors.camera_rig(rig_id).cameras
        blocks = [
            *camera_blocks(self._rig.cameras, self._rig.delay_s),
            *imu_blocks((self._imu,)),
        ]
        self.before = self.blocks = ParameterBlocks(blocks)
        kept = options.estimated() - {"intrinsics", "time_offset"}
        if not kept:
            raise EstimationError("the filter estimates neither intrinsics nor the time offset")
        options = dataclasses.replace(options, states=",".join(sorted(kept)))
        zero = np.zeros((0, 3))
        states = States(np.zeros((0, 7)), zero, zero, zero, zero, self.blocks)
        self.parameters = parameters_of(self._rig, 1, states, options)
        self._columns = np.array(
            [_column(one.block, one.row, one.column) for one in self.parameters.each]
        )
        self.size = _FIRST_CAMERA + 6 * len(self._cameras)
        self.P = np.zeros((self.size, self.size))
        self.P[self._columns, self._columns] = self.parameters.prior_sigma**2
        self.T_G_I = np.array(vi_map.T_G_I)
        self.first_T_G_I = self.T_G_I.copy()
        self.used = self.rejected = self._observations = self._count = 0
        self._square = 0.0

    def begin(self, vertices: I64) -> None:
        """Forget the motion and begin at the map's state of the first vertex of a mission."""
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

    def propagate(self, vertex: int) -> None:
        """Move to the next vertex along its inertial edge."""
        edge = self._edge_to.get(vertex, -1)
        if edge < 0:
            raise EstimationError("the filter needs an inertial edge between all vertices")
        data = InertialData.of_map(self._map, np.array([edge]))
        imu = dataclasses.replace(self._imu, intrinsics=intrinsics_of(self.blocks)[0])
        made = integrate(
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
        # between first estimates: what was predicted before the updates of the last vertex
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

    def remember(self, vertex: int) -> None:
        """Add the present pose to the window, and forget the oldest one when there are too many."""
        copied = np.concatenate([np.arange(len(self.P)), self.size + np.arange(6)])
        self.P = self.P[np.ix_(copied, copied)]
        self._window.append(vertex)
        if len(self._window) > WINDOW:
            self._window.pop(0)
            first = self.size + 15
            kept = np.concatenate([np.arange(first), np.arange(first + 6, len(self.P))])
            self.P = self.P[np.ix_(kept, kept)]

    def update(self, vertex: int) -> None:
        """Use the tracks that end here; their landmarks are eliminated."""
        chosen = self._ending.get(vertex)
        if chosen is None:
            return
        T_I_C = self.blocks[EXTRINSICS].values
        found = linearised(
            self.tracks,
            chosen,
            self.T_G_I,
            T_I_C,
            self.first_T_G_I,
            np.deg2rad(self._options.min_parallax_deg),
        )
        square = np.sum(found.residual**2, axis=1)
        is_off = np.bincount(found.track, square > _GATE**2, minlength=len(chosen)) > 0
        good = found.is_good & ~is_off
        self.used += int(good.sum())
        self.rejected += int((~good).sum())
        rows = np.flatnonzero(good[found.track])
        if not len(rows):
            return
        weight = np.sqrt(1.0 / (1.0 + square[rows] / _LOSS_SCALE**2))[:, None, None]
        H = self._state_jacobian(found.vertex[rows], found.camera[rows], found, rows) * weight
        by_point, error = found.by_point[rows] * weight, found.residual[rows] * weight[:, :, 0]
        self._square += float(square[rows].sum())
        self._observations += len(rows)
        self._count += 2 * len(rows) - 3 * int(good.sum())
        self._correct(*_eliminated(H, by_point, error, found.track[rows]))

    def _state_jacobian(self, vertex: I64, camera: I64, found: TrackResiduals, rows: I64) -> F64:
        H = np.zeros((len(rows), 2, len(self.P)))
        slot = vertex - self._window[0]
        pose = self.size + 15 + 6 * slot[:, None] + np.arange(6)
        mount = _FIRST_CAMERA + 6 * camera[:, None] + np.arange(6)
        np.put_along_axis(H, pose[:, None, :].repeat(2, 1), found.by_pose[rows], axis=2)
        np.put_along_axis(H, mount[:, None, :].repeat(2, 1), found.by_camera[rows], axis=2)
        return H

    def _correct(self, information: F64, right: F64) -> None:
        """Add information (d, d) and its right side (d,) to what is known."""
        P = np.linalg.solve(np.eye(len(self.P)) + self.P @ information, self.P)
        self.P = 0.5 * (P + P.T)
        step = self.P @ right
        now, poses = step[self.size : self.size + 15], step[self.size + 15 :].reshape(-1, 6)
        self.T_G_I[self._window] = se3.retract(self.T_G_I[self._window], poses)
        self.v_G = self.v_G + now[6:9]
        self.gyro_bias, self.accel_bias = self.gyro_bias + now[9:12], self.accel_bias + now[12:15]
        self.blocks = _moved(self.blocks, step[: self.size])

    def change(self) -> F64:
        """Return the change (k,) of the calibration so far."""
        return self.parameters.difference(self.blocks, self.before)

    def result(self, history: F64, seconds: float) -> FilteredCalibration:
        """Return what is known now."""
        zero = np.zeros((0, 3))
        states = States(np.zeros((0, 7)), zero, zero, zero, zero, self.blocks)
        sensors = with_cameras(self._map.sensors, self._rig, states)
        return FilteredCalibration(
            with_imus(sensors, (self._imu,), states),
            self.parameters,
            self.before,
            self.blocks,
            self.P[np.ix_(self._columns, self._columns)],
            history,
            self.T_G_I,
            self.used,
            self.rejected,
            self._observations,
            self._square / max(self._count, 1),
            seconds,
        )


def _column(block: str, row: int, column: int) -> int:
    """Return the place of a parameter among the states."""
    return _FIRST_CAMERA + 6 * row + column if block == EXTRINSICS else _IMU_COLUMNS[block] + column


def _moved(blocks: ParameterBlocks, step: F64) -> ParameterBlocks:
    """Apply a step of the calibration states."""
    by_block = {
        GYRO: step[None, 0:6],
        ACCEL: step[None, 6:12],
        ROTATION: step[None, 12:15],
        EXTRINSICS: step[_FIRST_CAMERA:].reshape(-1, 6),
    }
    return ParameterBlocks(
        block.moved(by_block[block.name].reshape(-1, 3)) if block.name in by_block else block
        for block in blocks
    )


def _groups(values: I64, rows: I64) -> list[tuple[int, I64]]:
    """Return the rows of every one of ascending values."""
    unique, first = np.unique(values, return_index=True)
    return list(zip(unique.tolist(), np.split(rows, first[1:]), strict=True))


def _eliminated(H: F64, by_point: F64, error: F64, track: I64) -> tuple[F64, F64]:
    """Return the information (d, d) of tracks on the states and its right side, without points.

    The Schur complement of a track's point is the projection on the left null space of its
    Jacobian.
    """
    size = H.shape[2]
    unique, own = np.unique(track, return_inverse=True)
    count = len(unique)
    points, cross = np.zeros((count, 3, 3)), np.zeros((count, 3, size + 1))
    np.add.at(points, own, by_point.transpose(0, 2, 1) @ by_point)
    right = np.concatenate([H, error[:, :, None]], axis=2)
    np.add.at(cross, own, by_point.transpose(0, 2, 1) @ right)
    flat, flat_cross = right.reshape(-1, size + 1), cross.reshape(-1, size + 1)
    solved = np.linalg.solve(points, cross).reshape(-1, size + 1)
    reduced = flat.T @ flat - flat_cross.T @ solved
    return reduced[:size, :size], reduced[:size, size]
