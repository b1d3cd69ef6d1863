"""A start from a trajectory that is known, so that tests of odometry do not depend on initialisation."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator

import numpy as np

from maplab_py.estimation.window.frame import StartState, WindowFrame
from maplab_py.frontend.odometry import Odometry
from maplab_py.frontend.odometry_update import OdometryUpdate
from maplab_py.frontend.starting import Start
from maplab_py.geometry.interpolation import interpolate_poses, nearest_rows
from maplab_py.interop.recordings.protocol import Event, ImuBatch, RecordedSensors, TrackedFrameSet
from maplab_py.interop.trajectories import Trajectory

SIGMA = np.repeat([1e-4, 5e-3, 0.05, 0.05, 0.3], 3)
"""Standard deviations of the start: position, attitude, velocity, biases of gyroscope and accelerometer."""


@dataclasses.dataclass
class KnownStart:
    """Starts at the first frame within a trajectory, with biases of zero unless it has them."""

    truth: Trajectory
    with_biases: bool = False
    reason: str = "the trajectory has not begun"

    def __call__(self, device: RecordedSensors) -> KnownStart:
        return self

    def push(self, frame: WindowFrame) -> Start | None:
        time_ns = np.array([frame.time_ns])
        T_M_I, is_known = interpolate_poses(
            self.truth.times_ns, self.truth.T_R_B, time_ns, max_gap_ns=10**9
        )
        if not is_known[0]:
            return None
        row = int(nearest_rows(self.truth.times_ns, time_ns)[0])
        assert self.truth.v_R is not None
        gyro_bias = accel_bias = np.zeros(3)
        if self.with_biases:
            assert self.truth.gyro_bias is not None
            assert self.truth.accel_bias is not None
            gyro_bias, accel_bias = self.truth.gyro_bias[row], self.truth.accel_bias[row]
        v_M, b_g, b_a = (x[None] for x in (self.truth.v_R[row], gyro_bias, accel_bias))
        state = StartState(time_ns, T_M_I, v_M, b_g, b_a, SIGMA)
        return Start(frame, state)


def updates_of(odometry: Odometry, events: Iterable[Event]) -> Iterator[OdometryUpdate]:
    """Yield the updates of an odometry that reads tracks and samples."""
    for event in events:
        if isinstance(event, ImuBatch):
            yield from odometry.push_imu(event)
        else:
            assert isinstance(event, TrackedFrameSet)
            yield from odometry.push_frames(event)
