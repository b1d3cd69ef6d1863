"""IMU samples that were recorded along a trajectory, in place of simulated ones."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from maplab_py.array_types import F64
from maplab_py.errors import MapError, UserError
from maplab_py.interop.imu_csv import read_imu_csv
from maplab_py.simulation.imu import ImuRecording
from maplab_py.simulation.scenario import SessionOptions
from maplab_py.simulation.trajectory_motion import read_motion


@dataclasses.dataclass(frozen=True, eq=False)
class RecordedSamples:
    """The samples within the part of a trajectory that is used."""

    time_s: F64  # (N,) since the start of that part
    imu: ImuRecording  # with the biases of the trajectory file


def recorded_samples(options: SessionOptions, lead_s: float = 0.0) -> RecordedSamples | None:
    """Read the recorded IMU samples of a session, None if it has simulated ones.

    Args:
        options: The session.
        lead_s: Time without samples at both ends of the motion [s].

    Raises:
        UserError: The file has no samples of that time, or the trajectory no biases, which are
            part of the truth.
    """
    if not options.recorded_imu:
        return None
    trajectory = read_motion(options)
    if trajectory.gyro_bias is None or trajectory.accel_bias is None:
        raise UserError(
            f"sessions.recorded_imu: {trajectory.source} has no biases, which are part of the truth; "
            "leave recorded_imu out to simulate the samples"
        )
    try:
        samples = read_imu_csv(Path(options.recorded_imu))
    except MapError as error:
        raise UserError(f"sessions.recorded_imu: {error}") from None
    start_ns = trajectory.times_ns[0] + round(options.trajectory_start_s * 1e9)
    time_s = (samples.times_ns - start_ns) * 1e-9
    inside = (time_s >= lead_s) & (time_s <= options.duration_s - lead_s)
    if np.count_nonzero(inside) < 2:
        raise UserError(
            f"sessions.recorded_imu: {options.recorded_imu} has no samples within the "
            f"{options.duration_s:g} s of {trajectory.source} that are used"
        )
    at, known = samples.times_ns[inside], trajectory.times_ns
    biases = (
        np.stack([np.interp(at, known, column) for column in table.T], axis=1)
        for table in (trajectory.accel_bias, trajectory.gyro_bias)
    )
    return RecordedSamples(time_s[inside], ImuRecording(samples.accel_gyro[inside], *biases))
