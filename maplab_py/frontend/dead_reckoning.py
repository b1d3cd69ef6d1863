"""Missions that follow each other, tied by the IMU samples between them.

After darkness or a covered lens the odometry starts a new mission. The last state before, and the samples
until the first state after it, say how the device has moved between them, and how surely.
"""

import dataclasses
from typing import Self

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.estimation.imu import inertial_data, preintegration
from maplab_py.geometry import se3, so3, yaw
from maplab_py.sensors import Imu
from maplab_py.vimap import VIMap, ids, merge, nav_state, tables

LONGEST_S = 20.0
"""Beyond this nothing useful is left of a velocity: 2 cm/s and 0.02 m/s^2 make 4 m."""
_KNOWN_M, _KNOWN_RAD = 1.0, 0.1
"""Deviations of place and heading up to which places may be looked for where the tie puts them."""
_SIGMA = np.repeat([1e-4, 0.01, 0.1, 2e-3, 0.05], 3)
"""Deviations of [p, theta, v, b_g, b_a] of a state whose own are not known."""
_HOLE_S = 0.02
_UNKNOWN_ACCELERATION, _UNKNOWN_RATE = 1.0, 0.5
"""Deviations [m/s^2, rad/s] of what happens in a hole between samples from the line between its ends."""


@dataclasses.dataclass(frozen=True, eq=False)
class Tie:
    """Pose of the first state of a mission in the last state of the one before."""

    T_A_B: F64  # (7,)
    covariance: F64  # (6, 6) of [dp, dtheta]: dp in A, dtheta in B
    duration_s: float

    @classmethod
    def by_samples(
        cls, imu: Imu, last: nav_state.NavState, covariance: F64 | None, times_ns: I64, samples: F64
    ) -> Self:
        """Integrate the samples (S, 6) from a state to the time of the last sample.

        Args:
            imu: For noise, scale and gravity.
            last: One state, at the time of the first sample.
            covariance: Of it (15, 15), order [p, theta, v, b_g, b_a]; None = not known.
            times_ns: Times (S,) of the samples.
            samples: As measured.
        """
        data = inertial_data.InertialData.of_samples(imu, [(times_ns, samples)])
        edge = preintegration.integrate(data, last.gyro_bias, last.accel_bias)
        t = float(edge.duration_s[0])
        R_I_M = so3.to_matrix(last.T_M_I[0, :4]).T
        gravity_M = np.array([0.0, 0.0, -imu.gravity_magnitude_mps2])
        fallen_I = R_I_M @ (last.v_M[0] * t + 0.5 * gravity_M * t**2)
        T_A_B = se3.make(edge.q_A_B[0], fallen_I + edge.dp[0])
        J = np.zeros((6, 15))
        J[:3, 3:6], J[:3, 6:9] = so3.skew(fallen_I), t * R_I_M
        J[:, 9:12], J[:, 12:] = edge.jacobian_gyro_bias[0, :6], edge.jacobian_accel_bias[0, :6]
        P = np.diag(_SIGMA**2) if covariance is None else covariance
        total = J @ P @ J.T + edge.covariance[0, :6, :6] + _of_holes(times_ns, gravity_M[2])
        return cls(T_A_B, 0.5 * (total + total.T), t)

    @property
    def position_sigma_m(self) -> float:
        """Deviation of the place about the worst axis."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[:3, :3])[-1]))

    @property
    def rotation_sigma_rad(self) -> float:
        """Deviation of the attitude about the worst axis."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[3:, 3:])[-1]))

    @property
    def is_known(self) -> bool:
        """Whether the second mission is placed well enough to count as placed."""
        return self.position_sigma_m <= _KNOWN_M and self.rotation_sigma_rad <= _KNOWN_RAD

    def base_frame(self, T_G_A: F64, T_M_B: F64) -> F64:
        """Return T_G_M (7,) of the second mission, gravity along -z."""
        T_G_B = se3.compose(T_G_A, self.T_A_B)
        q_G_M = so3.multiply(T_G_B[:4], so3.inverse(T_M_B[:4]))
        q_G_M = yaw.quaternion(yaw.yaw_of(q_G_M))
        return se3.make(q_G_M, T_G_B[4:] - so3.rotate(q_G_M, T_M_B[4:]))

    @property
    def words(self) -> str:
        """Return the tie in a few words."""
        sigma_m, sigma_deg = self.position_sigma_m, np.degrees(self.rotation_sigma_rad)
        return f"{self.duration_s:.1f} s of IMU samples: +- {sigma_m:.2f} m, {sigma_deg:.1f} deg"


def _of_holes(times_ns: I64, gravity: float) -> F64:
    """Return the covariance (6, 6) of what the samples do not show in the holes between them."""
    step_s = np.diff(times_ns) * 1e-9
    left_s = (times_ns[-1] - times_ns[1:]) * 1e-9
    hole_s, left_s = step_s[step_s > _HOLE_S], left_s[step_s > _HOLE_S]
    turn = _UNKNOWN_RATE * hole_s
    moved = _UNKNOWN_ACCELERATION * hole_s * (0.5 * hole_s + left_s)
    fallen = 0.5 * gravity * turn * (left_s + hole_s) ** 2
    variance = np.array([np.sum(moved**2 + fallen**2), np.sum(turn**2)])
    return np.diag(np.repeat(variance, 3))


def tied(before: VIMap, following: VIMap, tie: Tie) -> VIMap:
    """Return two maps stacked, the second, of one mission, placed by a tie to the last vertex of the first.

    Base frames count as known where the tie is sure enough.
    """
    a, b = len(before.vertices) - 1, len(before.vertices)
    first = following.vertices
    frames = following.baseframes.replace(
        T_G_M=tie.base_frame(before.T_G_I[a], first.T_M_I[0])[None]
    )
    result = merge.stack(before, following.replace(baseframes=frames))
    rng = np.random.default_rng(int(first.id[0, 0]))
    edge = tables.LoopClosureEdges.filled(
        1,
        id=ids.random_ids(1, rng),
        from_vertex=np.array([a]),
        to_vertex=np.array([b]),
        T_A_B=tie.T_A_B[None],
        covariance=tie.covariance[None],
    )
    edges = tables.LoopClosureEdges.concatenate([result.loop_closure_edges, edge])
    is_known = result.baseframes.is_known.copy()
    if tie.is_known:
        missions = result.vertices.mission[[a, b]]
        is_known[result.missions.baseframe[missions]] = True
    return result.replace(
        loop_closure_edges=edges, baseframes=result.baseframes.replace(is_known=is_known)
    )
