"""Velocities that the wheels of a simulated vehicle report."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.geometry import se3, so3
from maplab_py.interop.text_table import format_rows
from maplab_py.output_files import write_text
from maplab_py.simulation.recording import Recording
from maplab_py.simulation.scenario import OtherSensorOptions

_RATE_HZ = 50.0
_HEADER = "#timestamp [ns], vx [m/s], vy [m/s], wz [rad/s]\n"


@dataclasses.dataclass(frozen=True, eq=False)
class WheelVelocities:
    """Wheel measurements: velocity of the sensor S in S, distances times their scale."""

    times_ns: I64  # (N,)
    values: F64  # (N, 3) vx, vy [m/s], wz [rad/s]


def wheel_mounting(options: OtherSensorOptions) -> F64:
    """Return T_I_S (7,) of the wheel sensor."""
    return se3.make(so3.exp(options.wheel_turn_rad), np.asarray(options.wheel_position_m))


def wheel_velocities(
    recording: Recording, options: OtherSensorOptions, rng: np.random.Generator
) -> WheelVelocities:
    """Measure velocities whose integral over the time between two vertices has the stated errors.

    Args:
        recording: The true motion.
        options: Mounting, scale, and deviations per edge between vertices.
        rng: Random generator of the errors.
    """
    stamps = recording.imu_time_ns
    step = max(1, round(1e9 / _RATE_HZ / float(np.median(np.diff(stamps)))))
    motion = recording.imu_motion.take(np.arange(0, len(stamps), step))
    T_I_S = wheel_mounting(options)
    v_I = so3.rotate(so3.inverse(motion.T_G_I[:, :4]), motion.v_G)
    v_I = v_I + np.cross(motion.w_I, T_I_S[4:])
    v_S, w_S = (so3.rotate(so3.inverse(T_I_S[:4]), x) for x in (v_I, motion.w_I))
    values = np.column_stack([options.wheel_scale * v_S[:, :2], w_S[:, 2]])
    row_s = 1e-9 * float(np.median(np.diff(stamps[::step])))
    edge_s = 1e-9 * float(np.median(np.diff(recording.time_ns)))
    sigma = np.array([*[options.odometry_sigma_m] * 2, np.deg2rad(options.odometry_sigma_deg)])
    values += sigma / np.sqrt(row_s * edge_s) * rng.standard_normal(values.shape)
    return WheelVelocities(stamps[::step], values)


def write_wheel_velocities(wheels: WheelVelocities, path: Path, *, overwrite: bool) -> None:
    """Write CSV that `import_wheel_odometry` reads.

    Raises:
        UserError: The file exists and `overwrite` is not set, or cannot be written.
    """
    rows = format_rows("%d,%.9g,%.9g,%.9g", [wheels.times_ns, wheels.values])
    write_text(path, [_HEADER, *rows], overwrite=overwrite)
