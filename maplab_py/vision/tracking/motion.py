"""Motion of a camera between two images: outliers, disparity without the turn, turns on the spot."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.array_types import F64, Mask
from maplab_py.geometry import so3
from maplab_py.sensors import Camera
from maplab_py.sensors.projection import project
from maplab_py.vision.tracking.options import TrackingOptions
from maplab_py.vision.tracking.two_point_kernels import (
    TwoPointLimits,
    TwoPointResult,
    search_turn,
    search_two_point,
)

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
        turn_sigma=KNOWN_TURN_SIGMA_RAD,
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
        camera: The camera.
        rays: Unit rays (K, 3) of the earlier and of the later image.
        uv_px: Keypoints (K, 2) of the later image, recorded pixels.
        R_C1_C0: Turn (3, 3) from the earlier to the later camera, None = unknown.
        limits: Thresholds.
        seed: Of the draws.
        turned_px: Where the given turn alone takes the keypoints (K, 2), if that is known already.
    """
    motion = two_point_motion(*rays, R_C1_C0, limits, seed)
    rows = motion.is_inlier
    if turned_px is None or R_C1_C0 is None:
        turned_px, _ = project(camera, rays[0] @ motion.R_C1_C0.T)
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


KNOWN_TURN_SIGMA_RAD = 5e-3
"""Deviation of a turn that the gyroscope predicts: a bias of 0.1 rad/s in an image interval of 50 ms."""
UNKNOWN_TURN_SIGMA_RAD = 0.1
_UNKNOWN_TURN_ROUNDS = (8.0, 4.0, 2.0, 1.0)
"""An unknown turn is refined with thresholds that shrink to the given ones."""


@dataclasses.dataclass(frozen=True, eq=False)
class TwoPointMotion:
    """Motion of a camera between two images, from the rays of tracks."""

    is_inlier: Mask  # (K,) agrees with the turn or with turn and translation
    is_still: Mask  # (K,) agrees with the turn alone
    R_C1_C0: F64  # (3, 3) as given, else as estimated
    R_C1_C0_refined: F64  # (3, 3)
    direction_C1: F64  # (3,) unit, of the earlier camera from the later one; zero: unknown


def two_point_motion(
    ray_C0: F64, ray_C1: F64, R_C1_C0: F64 | None, limits: TwoPointLimits, seed: int
) -> TwoPointMotion:
    """Separate tracks that agree with the motion of a camera from outliers.

    The union of inliers of a turn and of a translation with known turn is maplab's
    (C. Troiani, A. Martinelli, C. Laugier, D. Scaramuzza, 2-Point-based Outlier Rejection for
    Camera-IMU Systems, ICRA 2014); the refinement of turn and direction, which takes in a bias of
    the gyroscope, allows a gate as tight as the noise of keypoints.

    Args:
        ray_C0: Unit rays (K, 3) of the earlier image.
        ray_C1: Unit rays (K, 3) of the later image.
        R_C1_C0: Turn (3, 3) as predicted by the gyroscope, None when it is unknown.
        limits: Thresholds; `turn_sigma` is replaced.
        seed: Of the draws.
    """
    word = np.uint64(seed % 2**64)
    if R_C1_C0 is not None:
        given = np.array(R_C1_C0, dtype=np.float64)
        return _search(
            ray_C0, ray_C1, given, limits._replace(turn_sigma=KNOWN_TURN_SIGMA_RAD), word
        )
    turn = np.eye(3)
    search_turn(ray_C0, ray_C1, limits, word, turn)
    for factor in _UNKNOWN_TURN_ROUNDS:
        wide = TwoPointLimits(
            factor * limits.threshold,
            factor * limits.gate,
            UNKNOWN_TURN_SIGMA_RAD,
            limits.max_iterations,
        )
        motion = _search(ray_C0, ray_C1, turn, wide, word)
        turn = motion.R_C1_C0_refined
    return motion


def _search(
    ray_C0: F64, ray_C1: F64, R_C1_C0: F64, limits: TwoPointLimits, word: np.uint64
) -> TwoPointMotion:
    count = len(ray_C0)
    result = TwoPointResult(
        np.zeros(count, dtype=np.bool_), np.zeros(count, dtype=np.bool_), np.zeros(3), np.zeros(3)
    )
    turned = np.ascontiguousarray(ray_C0 @ R_C1_C0.T)
    search_two_point(turned, ray_C1, limits, word, result)
    correction = so3.to_matrix(so3.exp(result.turn))
    return TwoPointMotion(
        is_inlier=result.is_inlier,
        is_still=result.is_still,
        R_C1_C0=R_C1_C0,
        R_C1_C0_refined=correction @ R_C1_C0,
        direction_C1=result.direction,
    )
