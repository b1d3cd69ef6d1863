"""Result of a smoother update."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.array_types import F64, I64


@dataclasses.dataclass(frozen=True, eq=False)
class ReleasedStates:
    """Final estimates of N frames that have left the window, in the order of time."""

    time_ns: I64  # (N,)
    T_M_I: F64  # (N, 7)
    v_M: F64  # (N, 3)
    gyro_bias: F64  # (N, 3)
    accel_bias: F64  # (N, 3)

    @classmethod
    def of_frames(cls, released: list[tuple[int, F64, F64]]) -> ReleasedStates:
        """Stack time, pose (7,) and motion (9,) of N frames."""
        times = np.array([t for t, _, _ in released], dtype=np.int64)
        T_M_I = np.array([T for _, T, _ in released]).reshape(-1, 7)
        motion = np.array([m for _, _, m in released]).reshape(-1, 9)
        return cls(times, T_M_I, motion[:, :3], motion[:, 3:6], motion[:, 6:])

    def __len__(self) -> int:
        return len(self.time_ns)


@dataclasses.dataclass(frozen=True, eq=False)
class WindowUpdate:
    """The newest state, and how the window is."""

    time_ns: int
    T_M_I: F64  # (7,)
    v_M: F64  # (3,)
    gyro_bias: F64  # (3,)
    accel_bias: F64  # (3,)
    covariance: F64  # (15, 15) order [p, theta, v, b_g, b_a]; infinite where nothing is known
    is_keyframe: bool
    num_frames: int
    num_landmarks: int  # that were estimated
    num_observations: int  # of them
    median_error_px: float  # of all observations of landmarks; nan without any
    costs: dict[str, float]
    iterations: int
    termination: str
    released: ReleasedStates
    stage_ms: dict[str, float]  # processor time of this thread
