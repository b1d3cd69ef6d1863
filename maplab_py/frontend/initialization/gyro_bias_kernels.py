"""The compiled loops over pairs of rays for the bias of the gyroscope; see `gyro_bias`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.compilation import compiled
from maplab_py.estimation.kernels import so3

_LEAST_SINE = 1e-3
"""Rays nearer than this to the direction of translation count as so far from it."""


class PairedRays(NamedTuple):
    """Rays of the same tracks in P pairs of frames."""

    first: F64  # (M, 3) unit, in the IMU's frame
    second: F64  # (M, 3)
    sigma: F64  # (M,) [rad]
    start: I64  # (P + 1,) where the rays of a pair begin


class BiasSums(NamedTuple):
    """Normal equations of K unknowns b, and of every pair's direction t in its tangent plane."""

    H_bb: F64  # (K, K)
    g_b: F64  # (K,)
    H_tt: F64  # (P, 2, 2)
    H_bt: F64  # (P, K, 2)
    g_t: F64  # (P, 2)

    @classmethod
    def zeros(cls, pairs: int, unknowns: int) -> BiasSums:
        """Return the equations of nothing."""
        return cls(
            np.zeros((unknowns, unknowns)),
            np.zeros(unknowns),
            np.zeros((pairs, 2, 2)),
            np.zeros((pairs, unknowns, 2)),
            np.zeros((pairs, 2)),
        )


@compiled()
def accumulate_turns(q_A_B: F64, by_bias: F64, q_A_I: F64, jacobian: F64) -> None:
    """Chain the turns of E consecutive edges.

    Args:
        q_A_B: Turn (E, 4) of every edge.
        by_bias: Jacobian (E, 9, 3) of every edge by the bias, in rows 3 to 5 that of the turn.
        q_A_I: Attitudes (E + 1, 4); the first is given, the others are results.
        jacobian: Right perturbation (E + 1, 3, 3) of the attitudes by the bias, likewise.
    """
    R = np.empty((3, 3))
    for e in range(len(q_A_B)):
        x, y, z, w = so3.multiply(q_A_I[e], q_A_B[e])
        norm = np.sqrt(x * x + y * y + z * z + w * w)
        q = q_A_I[e + 1]
        q[0], q[1], q[2], q[3] = x / norm, y / norm, z / norm, w / norm
        so3.to_matrix(q_A_B[e], R)
        for i in range(3):
            for j in range(3):
                total = by_bias[e, 3 + i, j]
                for k in range(3):
                    total += R[k, i] * jacobian[e, k, j]
                jacobian[e + 1, i, j] = total


@compiled()
def add_scatter(rays: PairedRays, R_i_j: F64, weight: F64, normal: F64, scatter: F64) -> None:
    """Compute the normals (M, 3) of the rays' planes, and sum their squares (P, 3, 3) by pair.

    Args:
        R_i_j: Turn (P, 3, 3) from the second to the first frame of each pair.
        weight: Robust weights (M,).
        normal: Result.
        scatter: Zeros, to which the sums are added.
    """
    turned = np.empty(3)
    for pair in range(len(R_i_j)):
        R = R_i_j[pair]
        for m in range(rays.start[pair], rays.start[pair + 1]):
            b = rays.second[m]
            for i in range(3):
                turned[i] = R[i, 0] * b[0] + R[i, 1] * b[1] + R[i, 2] * b[2]
            so3.cross(rays.first[m], turned, normal[m])
            w = weight[m] / (rays.sigma[m] * rays.sigma[m])
            for i in range(3):
                for j in range(3):
                    scatter[pair, i, j] += w * normal[m, i] * normal[m, j]


@compiled()
def add_equations(
    rays: PairedRays,
    R_i_j: F64,
    slope: F64,
    direction: F64,
    normal: F64,
    weight: F64,
    sums: BiasSums,
) -> None:
    """Compute robust weights (M,) at the present turns and directions, and sum the normal equations.

    A ray's residual is its distance to the plane of the other ray and the direction of translation.

    Args:
        R_i_j: Turn (P, 3, 3) from the second to the first frame of each pair.
        slope: Right perturbation (P, 3, K) of that turn by the unknowns: the bias, and what else there is.
        direction: Direction of translation and its tangent plane, as columns (P, 3, 3).
        normal: From `add_scatter`.
        weight: Result: Cauchy weights.
        sums: Zeros, to which the sums are added.
    """
    plane, back, by_turn = np.empty(3), np.empty(3), np.empty(3)
    count = slope.shape[2]
    J_b, J_t = np.empty(count), np.empty(2)
    for pair in range(len(R_i_j)):
        R, J, basis = R_i_j[pair], slope[pair], direction[pair]
        for m in range(rays.start[pair], rays.start[pair + 1]):
            n = normal[m]
            so3.cross(basis[:, 0], rays.first[m], plane)
            length = np.sqrt(plane[0] * plane[0] + plane[1] * plane[1] + plane[2] * plane[2])
            scale = 1.0 / (max(length, _LEAST_SINE) * rays.sigma[m])
            r = scale * (basis[0, 0] * n[0] + basis[1, 0] * n[1] + basis[2, 0] * n[2])
            w = 1.0 / (1.0 + r * r)
            weight[m] = w
            # t . (a x R (theta x b)) = theta . (b x R^T (t x a))
            for i in range(3):
                back[i] = R[0, i] * plane[0] + R[1, i] * plane[1] + R[2, i] * plane[2]
            so3.cross(rays.second[m], back, by_turn)
            for i in range(count):
                J_b[i] = by_turn[0] * J[0, i] + by_turn[1] * J[1, i] + by_turn[2] * J[2, i]
                J_b[i] *= scale
            for i in range(2):
                J_t[i] = n[0] * basis[0, i + 1] + n[1] * basis[1, i + 1] + n[2] * basis[2, i + 1]
                J_t[i] *= scale
            for i in range(count):
                sums.g_b[i] += w * J_b[i] * r
                for j in range(count):
                    sums.H_bb[i, j] += w * J_b[i] * J_b[j]
                for j in range(2):
                    sums.H_bt[pair, i, j] += w * J_b[i] * J_t[j]
            for i in range(2):
                sums.g_t[pair, i] += w * J_t[i] * r
                for j in range(2):
                    sums.H_tt[pair, i, j] += w * J_t[i] * J_t[j]
