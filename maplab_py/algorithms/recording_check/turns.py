"""Rotations of a camera from its images alone, and compared with the gyroscope.

Notation: 1 and 2 are the two images of a pair, R_1_2 the attitude of the camera at the second in the frame
of the first. Residuals are distances of rays to epipolar planes in units of pixels; directions of translation
are eliminated (L. Kneip, S. Lynen, Direct Optimization of Frame-to-Frame Rotation, ICCV 2013, with the
distance to the plane in place of the algebraic error).
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

from maplab_py.algorithms.recording_check.image_samples import PointPairs
from maplab_py.array_types import F64, I64, Mask, Rows
from maplab_py.geometry import so3
from maplab_py.sensors import Camera
from maplab_py.vision.tracking.ray_table import RayTable

_ROUNDS, _KABSCH_ROUNDS = 8, 5
_LEAST_POINTS = 10
_HUBER = 1.5
"""Deviations above so many times their usual size count less."""
_SMALLEST_PX = 0.05
_LEAST_SINE = 0.05
"""Rays nearer to the direction of translation than this say nothing about their plane's distance."""
_DAMPING = 1e-6


class RayPairs(Rows):
    """Unit rays of the points of P pairs of images, and the times of the images."""

    first_ns: I64  # (P,)
    second_ns: I64  # (P,)
    ray: F64  # (P, K, 2, 3) in the camera's frame
    row_share: F64  # (P, K, 2) rows of the points from -0.5 at the top to 0.5
    is_point: Mask  # (P, K)
    focal_px: float

    @property
    def duration_s(self) -> F64:
        """Time (P,) from the first to the second image."""
        return np.asarray((self.second_ns - self.first_ns) * 1e-9)

    def later(self, delay_s: float) -> RayPairs:
        """Return the pairs with later times."""
        shift_ns = round(delay_s * 1e9)
        return dataclasses.replace(
            self, first_ns=self.first_ns + shift_ns, second_ns=self.second_ns + shift_ns
        )

    @classmethod
    def of(cls, pairs: PointPairs, camera: Camera) -> RayPairs:
        """Make rays of points by the camera's model; pairs with too few are left out."""
        table = RayTable.of(camera)
        ray, exists = table.rays(pairs.uv_px.reshape(-1, 2))
        ray = np.nan_to_num(ray).reshape(*pairs.uv_px.shape[:3], 3)
        is_point = pairs.is_point & exists.reshape(pairs.uv_px.shape[:3]).all(axis=2)
        kept = is_point.sum(axis=1) >= _LEAST_POINTS
        share = pairs.uv_px[..., 1] / max(camera.height_px - 1, 1) - 0.5
        focal_px = float(np.mean(camera.central_focal_px))
        return cls(
            pairs.first_ns[kept],
            pairs.second_ns[kept],
            ray[kept],
            share[kept],
            is_point[kept],
            focal_px,
        )


class Epipolar(NamedTuple):
    """Epipolar geometry of pairs for given turns."""

    residual_px: F64  # (P, K)
    by_turn: F64  # (P, K, 3) derivatives by a right perturbation of R_1_2
    by_direction: F64  # (P, K, 2)
    by_first: F64  # (P, K, 3) derivatives by the first ray
    by_second: F64  # (P, K, 3)
    t: F64  # (P, 3) unit direction of the translation, in the first frame, its sign unknown


@dataclasses.dataclass(frozen=True, eq=False)
class ImageTurns:
    """Turns between images by the images alone."""

    phi: F64  # (P, 3) rotation vectors of R_1_2
    t: F64  # (P, 3) direction of the translation in the first frame; points lie ahead
    parallax_rad: F64  # (P,) median
    error_px: F64  # (P,) median


def epipolar(rays: RayPairs, first: F64, second: F64, R_1_2: F64, weight: F64) -> Epipolar:
    """Return residuals of rays (P, K, 3) under turns (P, 3, 3), and their derivatives."""
    turned = second @ R_1_2.swapaxes(1, 2)
    normal = np.cross(first, turned)
    t = _directions(first, normal, weight)
    across = np.cross(t[:, None], first)
    sine = np.maximum(np.linalg.norm(across, axis=2), _LEAST_SINE)
    scale = rays.focal_px * rays.is_point / sine
    # t . (a x R b) = b . R^T (t x a): by b, and by a right perturbation of R
    back = across @ R_1_2
    basis = _bases(t)
    return Epipolar(
        (normal @ t[..., None])[..., 0] * scale,
        np.cross(second, back) * scale[..., None],
        normal @ basis * scale[..., None],
        np.cross(turned, t[:, None]) * scale[..., None],
        back * scale[..., None],
        t,
    )


def image_turns(rays: RayPairs) -> ImageTurns:
    """Estimate the turn of every pair by least squares from the turn without translation."""
    first, second = rays.ray[:, :, 0], rays.ray[:, :, 1]
    weight = rays.is_point.astype(np.float64)
    R = np.broadcast_to(np.eye(3), (len(rays), 3, 3))
    for _ in range(_KABSCH_ROUNDS):
        R = kabsch(first, second, weight)
        off = np.linalg.norm(first - second @ R.swapaxes(1, 2), axis=2)
        weight = robust_weights(off * rays.focal_px, rays.is_point, by_row=True)
    weight = rays.is_point.astype(np.float64)
    for _ in range(_ROUNDS):
        at = epipolar(rays, first, second, R, weight)
        weight = robust_weights(at.residual_px, rays.is_point, by_row=True)
        J = np.concatenate([at.by_turn, at.by_direction], axis=2)
        JtW = (weight[..., None] * J).swapaxes(1, 2)
        H, g = JtW @ J, JtW @ at.residual_px[..., None]
        size = np.trace(H, axis1=1, axis2=2)[:, None, None] + 1e-9
        step = -np.linalg.solve(H + _DAMPING * size * np.eye(5), g)[:, :3, 0]
        R = R @ so3.to_matrix(so3.exp(np.clip(step, -0.05, 0.05)))
    at = epipolar(rays, first, second, R, weight)
    turned = second @ R.swapaxes(1, 2)
    normal, flow = np.cross(first, turned), np.cross(first, at.t[:, None])
    # depth of the second camera's points has the sign of -(first x t) . (first x turned)
    ahead = -np.sign(np.einsum("pki,pki->pk", flow, normal)) * (weight > 0.3)
    sign = np.where(ahead.sum(axis=1) < 0.0, -1.0, 1.0)
    parallax = np.where(rays.is_point, np.linalg.norm(normal, axis=2), np.nan)
    error = np.where(rays.is_point, np.abs(at.residual_px), np.nan)
    return ImageTurns(
        so3.log(so3.from_matrix(R)),
        at.t * sign[:, None],
        np.nanmedian(parallax, axis=1) if len(rays) else np.zeros(0),
        np.nanmedian(error, axis=1) if len(rays) else np.zeros(0),
    )


def kabsch(first: F64, second: F64, weight: F64) -> F64:
    """Return the rotations (..., 3, 3) that take second vectors (..., K, 3) to first ones."""
    M = (weight[..., None] * first).swapaxes(-2, -1) @ second
    U, _, Vt = np.linalg.svd(M)
    sign = np.linalg.det(U @ Vt)
    U = U.copy()
    U[..., :, 2] *= np.where(sign < 0.0, -1.0, 1.0)[..., None]
    return np.asarray(U @ Vt)


def robust_weights(residual: F64, is_used: Mask, *, by_row: bool) -> F64:
    """Return weights of residuals (P, K), by the median size of each row or of all together."""
    size = np.where(is_used, np.abs(residual), np.nan)
    axis = -1 if by_row else None
    usual = 1.4826 * np.nanmedian(size, axis=axis, keepdims=True) if size.size else size
    limit = _HUBER * np.maximum(usual, _SMALLEST_PX)
    return np.where(is_used, np.minimum(1.0, limit / np.maximum(np.abs(residual), 1e-12)) ** 2, 0.0)


def _directions(first: F64, normal: F64, weight: F64) -> F64:
    """Return unit directions t (P, 3) with t . normal = 0 as far as possible.

    Weights are those of distances to planes, for the directions of the round before.
    """
    t = np.zeros((len(first), 3))
    scale = weight
    for _ in range(2):
        scatter = (scale[..., None] * normal).swapaxes(1, 2) @ normal
        t = np.linalg.eigh(scatter)[1][..., 0]
        sine = np.linalg.norm(np.cross(t[:, None], first), axis=2)
        scale = weight / np.maximum(sine, _LEAST_SINE) ** 2
    return t


def _bases(t: F64) -> F64:
    """Return two unit vectors (P, 3, 2) orthogonal to unit vectors t (P, 3) and to each other."""
    axis = np.eye(3)[np.argmin(np.abs(t), axis=1)]
    a = np.cross(t, axis)
    a /= np.maximum(np.linalg.norm(a, axis=1, keepdims=True), 1e-12)
    return np.stack([a, np.cross(t, a)], axis=2)


class GyroTurns:
    """Turns by the gyroscope between any two times."""

    def __init__(self, times_ns: I64, rate: F64) -> None:
        """Integrate rates (N, 3) [rad/s]; samples are joined by straight lines."""
        kept = np.concatenate([[True], np.diff(times_ns) > 0])
        self._zero_ns = int(times_ns[0])
        self._times_s = (times_ns[kept] - self._zero_ns) * 1e-9
        self._rate = rate[kept]
        step = np.diff(self._times_s)[:, None]
        mean = 0.5 * (self._rate[1:] + self._rate[:-1])
        self._sum = np.concatenate([np.zeros((1, 3)), np.cumsum(mean * step, axis=0)])

    def covers(self, first_ns: I64, second_ns: I64, delay_s: float) -> Mask:
        """Return which intervals (P,) have samples when they are later by a delay."""
        first, second = (self._seconds(t) + delay_s for t in (first_ns, second_ns))
        return np.asarray((first >= 0.0) & (second <= self._times_s[-1]))

    def phi(self, first_ns: I64, second_ns: I64, delay_s: float = 0.0) -> F64:
        """Return the integrals (P, 3) of the rates: rotation vectors, for short intervals."""
        return np.asarray(self._at(second_ns, delay_s) - self._at(first_ns, delay_s))

    def rate_at(self, time_ns: I64, delay_s: float = 0.0) -> F64:
        """Return the rates (P, 3) at times."""
        at = self._seconds(time_ns) + delay_s
        return np.stack([np.interp(at, self._times_s, c) for c in self._rate.T], axis=1)

    def shifted(self, rate: F64) -> GyroTurns:
        """Return the same turns with a rate (3,) added."""
        times_ns = self._zero_ns + np.round(self._times_s * 1e9).astype(np.int64)
        return GyroTurns(times_ns, self._rate + rate)

    def _seconds(self, time_ns: I64) -> F64:
        return np.asarray((time_ns - self._zero_ns) * 1e-9)

    def _at(self, time_ns: I64, delay_s: float) -> F64:
        """Return the integral from the first sample to times (P,), exact between samples, too."""
        at = np.clip(self._seconds(time_ns) + delay_s, 0.0, self._times_s[-1])
        row = np.clip(
            np.searchsorted(self._times_s, at, side="right") - 1, 0, len(self._times_s) - 2
        )
        since = (at - self._times_s[row])[:, None]
        step = (self._times_s[row + 1] - self._times_s[row])[:, None]
        slope = (self._rate[row + 1] - self._rate[row]) / step
        return np.asarray(self._sum[row] + since * (self._rate[row] + 0.5 * since * slope))
