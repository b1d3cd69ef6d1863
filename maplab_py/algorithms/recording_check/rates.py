"""Comparison of camera rotation and gyroscope: errors of unit, axes, mounting and time."""

import dataclasses

import numpy as np

from maplab_py.algorithms.recording_check.hand_eye import (
    SIGNED_AXES,
    TURN,
    HandEye,
    RateMap,
    fit_hand_eye,
    fit_rates,
)
from maplab_py.algorithms.recording_check.signals import Signals
from maplab_py.algorithms.recording_check.turns import GyroTurns, ImageTurns, RayPairs, image_turns
from maplab_py.array_types import F64
from maplab_py.geometry import so3

_UNITS = {1.0: "rad/s", np.pi / 180.0: "deg/s", 180.0 / np.pi: "rad/s divided by 57.3"}
_AGREES, _MAY_AGREE, _FITS_PX = 0.5, 0.3, 0.3
"""Shares of the images' turns that the gyroscope explains where it agrees, and where it does if all
unknowns together bring the points so near to their epipolar planes: rolling shutters and walls look like
other turns."""
_WORSE = 1.15
_CLEARLY = 0.6
"""Signed axes are exchanged if that leaves at most this share of the deviation."""


@dataclasses.dataclass(frozen=True, eq=False)
class CameraTurns:
    """Analysis of one camera against the gyroscope."""

    rays: RayPairs
    turns: ImageTurns
    rate_deg: float  # usual turn of the images [deg/s]
    rate_map: RateMap | None
    unit: float  # rad/s that a unit of the gyroscope is
    unit_name: str
    axes: F64  # (3, 3) signed axes that take the gyroscope to the frame of the calibration
    gyro: GyroTurns | None  # in rad/s, with these axes
    bias: F64  # (3,) of it
    hand_eye: HandEye | None
    R_I_C: F64  # (3, 3) of the calibration

    @property
    def agrees(self) -> bool:
        """Whether the gyroscope explains the turns of the images at some delay."""
        if self.rate_map is None or self.rate_map.explained <= _MAY_AGREE:
            return False
        fits = self.hand_eye is not None and self.hand_eye.error_px < _FITS_PX
        return fits or self.rate_map.explained > _AGREES

    def is_better_than_held(self, held: slice) -> bool:
        """Tell whether the points fit clearly worse where some unknowns are those of the calibration.

        Before a flat wall, translations look like turns: a wrong estimate then fits hardly better.
        """
        fit = self.hand_eye
        if fit is None or self.gyro is None:
            return False
        R_I_C = self.R_I_C if held == TURN else fit.R_I_C
        kept = fit_hand_eye(self.rays, self.gyro, R_I_C, fit.gyro_bias, fit.delay_s, held=held)
        return kept is not None and kept.error_px > _WORSE * fit.error_px

    @property
    def mounting_error(self) -> F64:
        """Rotation vector (3,) of the estimated R_I_C against that of the calibration."""
        if self.hand_eye is None:
            return np.zeros(3)
        return so3.log(so3.from_matrix(self.R_I_C.T @ self.hand_eye.R_I_C))


def analyse_camera(signals: Signals, row: int) -> CameraTurns:
    """Analyse one camera."""
    device = signals.device
    rays = RayPairs.of(signals.cameras[row].pairs, device.cameras[row])
    turns = image_turns(rays)
    rates = np.linalg.norm(turns.phi, axis=1) / np.maximum(rays.duration_s, 1e-9)
    rate_deg = float(np.degrees(np.median(rates))) if len(rays) else 0.0
    R_I_C = so3.to_matrix(device.T_I_C[row, :4])
    nothing = CameraTurns(
        rays, turns, rate_deg, None, 1.0, "rad/s", np.eye(3), None, np.zeros(3), None, R_I_C
    )
    if len(signals.imu) < 10 or not len(rays):
        return nothing
    raw = signals.imu.accel_gyro[:, 3:]
    if device.imu is not None and device.imu.intrinsics is not None:
        raw = raw @ np.linalg.inv(device.imu.intrinsics.T_g).T
    rate_map = fit_rates(turns, rays, GyroTurns(signals.imu.times_ns, raw), R_I_C)
    if rate_map is None or rate_map.explained <= _MAY_AGREE:
        return dataclasses.replace(nothing, rate_map=rate_map)
    S = rate_map.scatter
    size = np.sqrt(np.trace(rate_map.A @ S @ rate_map.A.T) / max(np.trace(S), 1e-12))
    unit = min(_UNITS, key=lambda known: abs(np.log(max(size, 1e-12) / known)))
    A = rate_map.A / unit
    axes = _nearest_axes(A, S)
    gyro = GyroTurns(signals.imu.times_ns, unit * raw @ axes.T)
    R_A = _nearest_rotation(A @ axes.T @ (axes @ S @ axes.T))
    bias = -R_A.T @ rate_map.c
    hand_eye = _fit_from_several(rays, gyro, (R_A.T @ R_I_C, R_I_C), bias, rate_map.delay_s)
    return CameraTurns(
        rays,
        turns,
        rate_deg,
        rate_map,
        unit,
        _UNITS[unit],
        axes,
        gyro,
        bias if hand_eye is None else hand_eye.gyro_bias,
        hand_eye,
        R_I_C,
    )


def _fit_from_several(
    rays: RayPairs, gyro: GyroTurns, starts: tuple[F64, F64], bias: F64, delay_s: float
) -> HandEye | None:
    """Return the best fit of those from the map of the rates and from the calibration.

    Before a flat wall there are several minima: the calibration itself is then tried, too.
    """
    by_rates = fit_hand_eye(rays, gyro, starts[0], bias, delay_s)
    kept = fit_hand_eye(rays, gyro, starts[1], bias, delay_s, held=TURN)
    fits = [by_rates, kept]
    if kept is not None:
        fits.append(fit_hand_eye(rays, gyro, starts[1], kept.gyro_bias, kept.delay_s))
    return min((f for f in fits if f is not None), key=lambda f: f.error_px, default=None)


def _nearest_axes(A: F64, S: F64) -> F64:
    """Return the signed axes nearest to a map (3, 3), as far as motion of scatter S shows it."""
    costs = [float(np.trace((A - Q) @ S @ (A - Q).T)) for Q in SIGNED_AXES]
    best = int(np.argmin(costs))
    as_is = next(i for i, Q in enumerate(SIGNED_AXES) if np.array_equal(Q, np.eye(3)))
    return SIGNED_AXES[best if costs[best] < _CLEARLY * costs[as_is] else as_is]


def _nearest_rotation(M: F64) -> F64:
    U, _, Vt = np.linalg.svd(M)
    return np.asarray(U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt)
