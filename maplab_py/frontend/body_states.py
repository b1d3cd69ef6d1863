"""States of the body at several times."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.estimation.window.update import WindowUpdate


@dataclasses.dataclass(frozen=True, eq=False)
class BodyStates:
    """Estimated states at N times, in the mission frame M."""

    times_ns: I64  # (N,)
    T_M_I: F64  # (N, 7)
    v_M_I: F64  # (N, 3) [m/s], expressed in M
    gyro_bias: F64  # (N, 3) [rad/s]
    accel_bias: F64  # (N, 3) [m/s^2]

    @classmethod
    def single(
        cls, time_ns: int, T_M_I: F64, v_M_I: F64, gyro_bias: F64, accel_bias: F64
    ) -> BodyStates:
        """Return the state at one time, from columns without a first axis."""
        time = np.array([time_ns], dtype=np.int64)
        return cls(time, T_M_I[None], v_M_I[None], gyro_bias[None], accel_bias[None])

    @classmethod
    def of_motion(cls, times_ns: I64, T_M_I: F64, motion: F64) -> BodyStates:
        """Return states whose velocities and biases are columns (N, 9) [v, b_g, b_a]."""
        return cls(times_ns, T_M_I, motion[:, :3], motion[:, 3:6], motion[:, 6:])

    @classmethod
    def of_newest(cls, update: WindowUpdate) -> BodyStates:
        """Return the state of the newest frame of a window."""
        return cls.single(
            update.time_ns, update.T_M_I, update.v_M, update.gyro_bias, update.accel_bias
        )

    @classmethod
    def of_released(cls, update: WindowUpdate) -> BodyStates:
        """Return the states of the frames that have left a window."""
        past = update.released
        return cls(past.time_ns, past.T_M_I, past.v_M, past.gyro_bias, past.accel_bias)

    @classmethod
    def none(cls) -> BodyStates:
        """Return no states."""
        zeros = np.zeros((0, 3))
        return cls(np.zeros(0, dtype=np.int64), np.zeros((0, 7)), zeros, zeros, zeros)

    @classmethod
    def concatenate(cls, parts: list[BodyStates]) -> BodyStates:
        """Stack states, at least of one part."""
        names = [field.name for field in dataclasses.fields(cls)]
        return cls(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in names})

    def row(self, index: int) -> BodyStates:
        """Return the state of one time."""
        names = [field.name for field in dataclasses.fields(self)]
        return type(self)(**{name: getattr(self, name)[index : index + 1] for name in names})

    def __len__(self) -> int:
        return len(self.times_ns)
