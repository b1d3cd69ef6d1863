"""Motion of a camera between two images: outliers, disparity without the turn, turns on the spot."""

import dataclasses
from typing import NamedTuple

import numpy as np

from maplab_py.array_types import F64, Mask
from maplab_py.compilation import compiled
from maplab_py.geometry import so3
from maplab_py.sensors import Camera
from maplab_py.sensors.projection import project
from maplab_py.vision.random_numbers import random_below
from maplab_py.vision.tracking.options import TrackingOptions

# Rays a of the earlier image are turned to the camera's frame at the later image, whose rays are b. Without
# translation a = b; with translation t of the earlier camera, seen from the later one, a, b and t
# lie in a plane: distance_b b = distance_a a + t.

_TINY = 1e-12
_CONFIDENCE = 0.9999
_REFINEMENTS = 4


class TwoPointLimits(NamedTuple):
    """Thresholds of the search; angles as lengths of chords between unit vectors."""

    threshold: float  # of hypotheses
    gate: float  # after the refinement
    turn_sigma: float  # of the given turn [rad]
    max_iterations: int


class TwoPointResult(NamedTuple):
    """Filled in by `search_two_point`."""

    is_inlier: Mask  # (K,)
    is_still: Mask  # (K,) agrees with a turn without translation
    turn: F64  # (3,) small correction of the given turn [rad], in the later camera
    direction: F64  # (3,) unit, of the earlier camera from the later one; zero = unknown


@compiled(forceinline=True)
def _cross(a, b):  # type: ignore[no-untyped-def]
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


@compiled(forceinline=True)
def _dot(a, b):  # type: ignore[no-untyped-def]
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled(forceinline=True)
def _chord(a, b):  # type: ignore[no-untyped-def]
    x, y, z = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    return np.sqrt(x * x + y * y + z * z)


@compiled(forceinline=True)
def _turn(turn, a):  # type: ignore[no-untyped-def]
    """Turn a by a small rotation vector, to first order."""
    c = _cross(turn, a)
    return (a[0] + c[0], a[1] + c[1], a[2] + c[2])


@compiled(forceinline=True)
def _plane_error(t, a, b):  # type: ignore[no-untyped-def]
    """Return the signed distance of b to the plane of t and a."""
    normal = _cross(t, a)
    length = np.sqrt(_dot(normal, normal))
    return _dot(normal, b) / length if length > 1e-9 else _chord(a, b)


@compiled(forceinline=True)
def _is_moved(t, a, b, limit):  # type: ignore[no-untyped-def]
    """Tell whether the translation t explains the rays, with the point in front of both cameras."""
    if abs(_plane_error(t, a, b)) > limit:
        return False
    normal = _cross(a, b)
    ahead = _dot(normal, _cross(a, t)) > 0.0 and _dot(normal, _cross(b, t)) > 0.0
    return ahead or _chord(a, b) <= limit


@compiled()
def _count_moved(t, a, b, limit):  # type: ignore[no-untyped-def]
    count = 0
    for k in range(len(a)):
        count += _is_moved(t, a[k], b[k], limit)
    return count


@compiled()
def _needed(inliers, total, most):  # type: ignore[no-untyped-def]
    """Return after how many pairs of tracks one without an outlier has been drawn."""
    share = inliers / total
    miss = 1.0 - share * share
    if miss <= _TINY:
        return 1
    return min(most, int(np.ceil(np.log(1.0 - _CONFIDENCE) / np.log(miss))))


@compiled()
def _search_direction(a, b, limits, state, direction):  # type: ignore[no-untyped-def]
    """Fill in the direction of translation that most tracks agree with."""
    count, best, iteration, needed = len(a), 0, 0, limits.max_iterations
    direction[:] = 0.0
    while iteration < needed:
        iteration += 1
        i = random_below(state, count)
        j = (i + 1 + random_below(state, count - 1)) % count
        t = _cross(_cross(a[i], b[i]), _cross(a[j], b[j]))
        length = np.sqrt(_dot(t, t))
        if length < _TINY:
            continue
        # on the side of which the point of the first track is in front of the cameras
        sign = 1.0 if _dot(_cross(a[i], b[i]), _cross(a[i], t)) > 0.0 else -1.0
        t = (sign * t[0] / length, sign * t[1] / length, sign * t[2] / length)
        inliers = _count_moved(t, a, b, limits.threshold)
        if inliers > best:
            best = inliers
            direction[0], direction[1], direction[2] = t
            needed = _needed(inliers, count, limits.max_iterations)
    return best


@compiled()
def _refine(a, b, is_used, limits, turn, direction):  # type: ignore[no-untyped-def]
    """Refine turn and direction: Gauss-Newton on distances to epipolar planes, Cauchy's loss."""
    sigma = limits.gate / 3.0
    for _ in range(_REFINEMENTS):
        H, g = np.zeros((5, 5)), np.zeros(5)
        axis = np.zeros(3)
        axis[np.argmin(np.abs(direction))] = 1.0
        e1 = np.array(_cross(direction, axis))
        e1 /= np.sqrt(_dot(e1, e1))
        e2 = np.array(_cross(direction, e1))
        J = np.empty(5)
        for k in range(len(a)):
            if not is_used[k]:
                continue
            a_k = _turn(turn, a[k])
            normal = _cross(direction, a_k)
            length = np.sqrt(_dot(normal, normal))
            if length < 1e-6:
                continue
            r = _dot(normal, b[k]) / (length * sigma)
            # t . ((d x a) x b) = d . (a x (b x t)) and t . (a x b)
            by_turn, by_direction = _cross(a_k, _cross(b[k], direction)), _cross(a_k, b[k])
            scale = 1.0 / (length * sigma)
            J[0], J[1], J[2] = by_turn[0] * scale, by_turn[1] * scale, by_turn[2] * scale
            J[3], J[4] = _dot(by_direction, e1) * scale, _dot(by_direction, e2) * scale
            weight = 1.0 / (1.0 + r * r)
            for row in range(5):
                g[row] += weight * J[row] * r
                for column in range(5):
                    H[row, column] += weight * J[row] * J[column]
        for row in range(3):
            H[row, row] += 1.0 / limits.turn_sigma**2
            g[row] += turn[row] / limits.turn_sigma**2
        H[3, 3] += 1.0
        H[4, 4] += 1.0
        step = np.linalg.solve(H, g)
        turn -= step[:3]
        direction -= step[3] * e1 + step[4] * e2
        direction /= np.sqrt(_dot(direction, direction))


@compiled()
def search_two_point(a, b, limits, seed, result):  # type: ignore[no-untyped-def]
    """Find the tracks that agree with the given turn, with or without a translation.

    A translation is searched in the planes of two tracks each; its inliers together with those of
    the turn alone refine turn and direction, and the union of the inliers of both, after the refinement
    and with a tighter gate, remains.

    Args:
        a: Rays (K, 3) of the earlier image, unit, turned to the later camera.
        b: Rays (K, 3) of the later image, unit.
        limits: TwoPointLimits.
        seed: Of the draws.
        result: TwoPointResult, filled in.
    """
    count = len(a)
    state = np.array([seed], dtype=np.uint64)
    result.turn[:] = 0.0
    result.direction[:] = 0.0
    best = _search_direction(a, b, limits, state, result.direction) if count >= 2 else 0
    used = 0
    for k in range(count):
        result.is_still[k] = _chord(a[k], b[k]) <= limits.gate
        is_moved = best > 0 and _is_moved(result.direction, a[k], b[k], limits.threshold)
        result.is_inlier[k] = is_moved or _chord(a[k], b[k]) <= limits.threshold
        used += result.is_inlier[k]
    if best == 0 or used < 8:
        return
    _refine(a, b, result.is_inlier, limits, result.turn, result.direction)
    for k in range(count):
        a_k = _turn(result.turn, a[k])
        is_moved = _is_moved(result.direction, a_k, b[k], limits.gate)
        result.is_inlier[k] = is_moved or _chord(a_k, b[k]) <= limits.gate


@compiled()
def _turn_between(a1, a2, b1, b2, R):  # type: ignore[no-untyped-def]
    """Fill in the rotation that takes the axes of the rays a1, a2 to those of b1, b2."""
    axes = np.empty((2, 3, 3))
    for side in range(2):
        first, second = (a1, a2) if side == 0 else (b1, b2)
        s = (first[0] + second[0], first[1] + second[1], first[2] + second[2])
        n = _cross(first, second)
        length_s, length_n = np.sqrt(_dot(s, s)), np.sqrt(_dot(n, n))
        if length_s < 1e-9 or length_n < 1e-6:
            return False
        for i in range(3):
            axes[side, i, 0], axes[side, i, 1] = s[i] / length_s, n[i] / length_n
        axes[side, :, 2] = np.array(_cross(axes[side, :, 0].copy(), axes[side, :, 1].copy()))
    R[:] = axes[1] @ axes[0].T
    return True


@compiled()
def search_turn(a, b, limits, seed, R):  # type: ignore[no-untyped-def]
    """Fill in the rotation R (3, 3) that takes most rays a (K, 3) to rays b; return its inliers."""
    count, best, iteration, needed = len(a), 0, 0, limits.max_iterations
    state = np.array([seed], dtype=np.uint64)
    trial = np.empty((3, 3))
    R[:] = np.eye(3)
    while count >= 2 and iteration < needed:
        iteration += 1
        i = random_below(state, count)
        j = (i + 1 + random_below(state, count - 1)) % count
        if not _turn_between(a[i], a[j], b[i], b[j], trial):
            continue
        inliers = 0
        for k in range(count):
            inliers += _chord(trial @ a[k], b[k]) <= limits.threshold
        if inliers > best:
            best = inliers
            R[:] = trial
            needed = _needed(inliers, count, limits.max_iterations)
    return best


_TURN_SHARE = 0.9
"""Share of the tracks that must agree with a turn without translation."""
_MIN_TURN_TRACKS = 8


@dataclasses.dataclass(frozen=True, eq=False)
class ImageMotion:
    """Motion of a camera since the previous image, estimated from K tracks."""

    is_inlier: Mask  # (K,) agrees with the turn, with or without translation
    is_still: Mask  # (I,) of the inliers: agrees with the turn alone
    disparity_px: F64  # (I,) of the inliers, without the turn


def limits_of(options: TrackingOptions, focal_px: float) -> TwoPointLimits:
    """Return the thresholds of the two-point RANSAC for a camera."""
    return TwoPointLimits(
        threshold=float(np.sqrt(2.0 * options.two_pt_ransac_threshold)),
        gate=options.epipolar_gate_px / focal_px,
        turn_sigma=_KNOWN_TURN_SIGMA_RAD,
        max_iterations=options.two_pt_ransac_max_iterations,
    )


def image_motion(
    camera: Camera,
    rays: tuple[F64, F64],
    uv_px: F64,
    R_C1_C0: F64 | None,
    limits: TwoPointLimits,
    seed: int,
    turned_px: F64 | None = None,
) -> ImageMotion:
    """Compare tracks in two images of a camera.

    Args:
        rays: Unit rays (K, 3) of the earlier and of the later image.
        uv_px: Keypoints (K, 2) of the later image, recorded pixels.
        R_C1_C0: Turn (3, 3) from the earlier to the later camera, None = unknown.
        limits: Thresholds.
        seed: Of the draws.
        turned_px: Where the given turn alone takes the keypoints (K, 2), if that is known already.
    """
    motion, given = two_point_motion(*rays, R_C1_C0, limits, seed)
    rows = motion.is_inlier
    if turned_px is None or R_C1_C0 is None:
        turned_px, _ = project(camera, rays[0] @ given.T)
    disparity_px = np.linalg.norm(uv_px[rows] - turned_px[rows], axis=1)
    return ImageMotion(rows, motion.is_still[rows], disparity_px)


def camera_turn(R_I_C: F64, R_I0_I1: F64 | None) -> F64 | None:
    """Return R_C1_C0 (3, 3) of a camera from the turn of the IMU."""
    return None if R_I0_I1 is None else np.asarray(R_I_C.T @ R_I0_I1.T @ R_I_C)


def summarise(motions: list[ImageMotion]) -> tuple[float, bool]:
    """Return the median disparity [px] and whether the rig only turned; (NaN, False) without tracks."""
    disparity = np.concatenate([motion.disparity_px for motion in motions] or [np.zeros(0)])
    still = np.concatenate([motion.is_still for motion in motions] or [np.zeros(0, dtype=np.bool_)])
    is_turn_only = len(still) >= _MIN_TURN_TRACKS and float(np.mean(still)) >= _TURN_SHARE
    return float(np.median(disparity)) if len(disparity) else float("nan"), is_turn_only


_KNOWN_TURN_SIGMA_RAD, _UNKNOWN_TURN_SIGMA_RAD = 5e-3, 0.1
"""Deviations of turns that the gyroscope predicts, a bias of 0.1 rad/s for 50 ms, and of others."""
_UNKNOWN_TURN_ROUNDS = (8.0, 4.0, 2.0, 1.0)
"""An unknown turn is refined with thresholds that shrink to the given ones."""


def two_point_motion(
    ray_C0: F64, ray_C1: F64, R_C1_C0: F64 | None, limits: TwoPointLimits, seed: int
) -> tuple[TwoPointResult, F64]:
    """Separate tracks that agree with the motion of a camera from outliers.

    The union of inliers of a turn and of a translation with known turn is maplab's
    (C. Troiani, A. Martinelli, C. Laugier, D. Scaramuzza, 2-Point-based Outlier Rejection for
    Camera-IMU Systems, ICRA 2014); the refinement of turn and direction, which takes in a bias of
    the gyroscope, allows a gate as tight as the noise of keypoints.

    Args:
        ray_C0: Unit rays (K, 3) of the earlier image.
        ray_C1: Unit rays (K, 3) of the later image.
        R_C1_C0: Turn (3, 3) as predicted by the gyroscope, None when it is unknown.
        limits: Thresholds for a turn that the gyroscope predicts.
        seed: Of the draws.

    Returns:
        The motion, and the turn R_C1_C0 (3, 3) that it corrects: as given, else as estimated.
    """
    word = np.uint64(seed % 2**64)
    if R_C1_C0 is not None:
        given = np.array(R_C1_C0, dtype=np.float64)
        return _search(ray_C0, ray_C1, given, limits, word), given
    turn = np.eye(3)
    search_turn(ray_C0, ray_C1, limits, word, turn)
    *wide, last = (
        TwoPointLimits(
            factor * limits.threshold,
            factor * limits.gate,
            _UNKNOWN_TURN_SIGMA_RAD,
            limits.max_iterations,
        )
        for factor in _UNKNOWN_TURN_ROUNDS
    )
    for of_round in wide:
        motion = _search(ray_C0, ray_C1, turn, of_round, word)
        turn = so3.to_matrix(so3.exp(motion.turn)) @ turn
    return _search(ray_C0, ray_C1, turn, last, word), turn


def _search(
    ray_C0: F64, ray_C1: F64, R_C1_C0: F64, limits: TwoPointLimits, word: np.uint64
) -> TwoPointResult:
    count = len(ray_C0)
    result = TwoPointResult(
        np.zeros(count, dtype=np.bool_), np.zeros(count, dtype=np.bool_), np.zeros(3), np.zeros(3)
    )
    turned = np.ascontiguousarray(ray_C0 @ R_C1_C0.T)
    search_two_point(turned, ray_C1, limits, word, result)
    return result
