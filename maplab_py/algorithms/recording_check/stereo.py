"""The geometry of two cameras, compared with points that both observe."""

import dataclasses
from typing import Any

import numpy as np

from maplab_py.array_types import F64, U8
from maplab_py.geometry import se3, so3
from maplab_py.sensors import Camera, projection
from maplab_py.vision.tracking.flow import FlowOptions, follow

_MOST_SETS = 60
_FEATURES = 500
_CLEARLY = 0.75
"""Ratio of the differences of the best and the second best descriptor."""
_FLOW = FlowOptions(patch_size_px=21, levels=1, forward_backward_px=0.7)


class StereoSampler:
    """Finds points of the first camera's images in those of another, without the calibration."""

    def __init__(self, first: Camera, second: Camera) -> None:
        """Begin without images; cameras of different sizes are matched without refinement."""
        self._is_alike = (first.width_px, first.height_px) == (second.width_px, second.height_px)
        self._points: list[F64] = []
        self._tools: tuple[Any, Any] | None = None

    def add(self, first: U8, second: U8) -> None:
        """Match two images (H, W) that were taken at the same time."""
        import cv2

        if len(self._points) >= _MOST_SETS:
            return
        if self._tools is None:
            library: Any = cv2
            self._tools = library.ORB_create(_FEATURES), library.BFMatcher(cv2.NORM_HAMMING)
        detector, matcher = self._tools
        keys_1, words_1 = detector.detectAndCompute(first, None)
        keys_2, words_2 = detector.detectAndCompute(second, None)
        if words_1 is None or words_2 is None or len(keys_1) < 2 or len(keys_2) < 2:
            return
        there = matcher.knnMatch(words_1, words_2, k=2)
        back = {m.queryIdx: m.trainIdx for m in matcher.match(words_2, words_1)}
        rows = [
            (best.queryIdx, best.trainIdx)
            for best, second_best in there
            if best.distance < _CLEARLY * second_best.distance
            and back.get(best.trainIdx) == best.queryIdx
        ]
        if not rows:
            return
        i, j = np.array(rows).T
        uv_1 = np.array([key.pt for key in keys_1])[i]
        uv_2 = np.array([key.pt for key in keys_2])[j]
        if self._is_alike:
            moved, is_tracked = follow(first, second, uv_1, uv_2, _FLOW)
            is_tracked &= np.linalg.norm(moved - uv_2, axis=1) < 4.0
            uv_1, uv_2 = uv_1[is_tracked], moved[is_tracked]
        self._points.append(np.stack([uv_1, uv_2], axis=1))

    def points(self) -> F64:
        """Return the points (M, 2, 2) [px] by point and camera."""
        if not self._points:
            return np.zeros((0, 2, 2))
        return np.concatenate(self._points)


@dataclasses.dataclass(frozen=True)
class StereoFit:
    """Distances of points to epipolar lines [px], medians, for several explanations."""

    as_is: float  # with the calibration
    swapped: float  # with the cameras exchanged
    moved: float  # with another pose of the second camera
    turn_deg: float  # of that pose against the calibration
    points: int


_LEAST_POINTS = 60
_ROUNDS = 10
_LEAST_SINE = 0.02
_RANSAC_PX = 2.0


def fit_stereo(points: F64, cameras: tuple[Camera, Camera], T_1_2: F64) -> StereoFit | None:
    """Compare points (M, 2, 2) [px] of two cameras with their poses.

    Returns:
        None if there are too few points.
    """
    if len(points) < _LEAST_POINTS:
        return None
    rays, exists = _rays(points, cameras)
    swapped, also = _rays(points, cameras[::-1])
    focal_px = float(np.mean([camera.central_focal_px.mean() for camera in cameras]))
    is_inlier = _inliers(rays, focal_px) & exists & also
    if np.count_nonzero(is_inlier) < _LEAST_POINTS:
        return None
    rays, swapped = rays[is_inlier], swapped[is_inlier]
    R, t = so3.to_matrix(T_1_2[:4]), T_1_2[4:] / max(float(np.linalg.norm(T_1_2[4:])), 1e-9)
    T_2_1 = se3.inverse(T_1_2)
    t_back = T_2_1[4:] / max(float(np.linalg.norm(T_2_1[4:])), 1e-9)
    back = so3.to_matrix(T_2_1[:4])
    moved_R, moved_t = _refined(rays, R, t)
    return StereoFit(
        _median_px(rays, R, t, focal_px),
        _median_px(swapped, back, t_back, focal_px),
        _median_px(rays, moved_R, moved_t, focal_px),
        float(np.degrees(np.linalg.norm(so3.log(so3.from_matrix(R.T @ moved_R))))),
        len(rays),
    )


def _rays(points: F64, cameras: tuple[Camera, ...]) -> tuple[F64, Any]:
    parts = [projection.back_project(camera, points[:, i]) for i, camera in enumerate(cameras)]
    ray = np.stack([np.nan_to_num(part[0]) for part in parts], axis=1)
    length = np.maximum(np.linalg.norm(ray, axis=2, keepdims=True), 1e-12)
    return ray / length, parts[0][1] & parts[1][1]


def _inliers(rays: F64, focal_px: float) -> Any:
    """Return the points that some essential matrix explains, loosely: lenses may be wrong."""
    import cv2

    ahead = (rays[..., 2] > 0.2).all(axis=1)
    flat = rays[ahead][..., :2] / rays[ahead][..., 2:]
    is_inlier = np.zeros(len(rays), dtype=np.bool_)
    if len(flat) < _LEAST_POINTS:
        return is_inlier
    cv2.setRNGSeed(0)
    _, mask = cv2.findEssentialMat(
        flat[:, 0], flat[:, 1], np.eye(3), cv2.RANSAC, 0.999, 4.0 * _RANSAC_PX / focal_px
    )
    if mask is not None:
        is_inlier[np.flatnonzero(ahead)[mask.ravel() > 0]] = True
    return is_inlier


def _distances(rays: F64, R: F64, t: F64) -> tuple[F64, F64, F64]:
    """Return distances to epipolar planes (M,) [rad], their derivatives by a turn (M, 3) and by t (M, 3)."""
    first, second = rays[:, 0], rays[:, 1]
    turned = second @ R.T
    across = np.cross(t, first)
    sine = np.maximum(np.linalg.norm(across, axis=1), _LEAST_SINE)
    back = across @ R
    normal = np.cross(first, turned)
    return (normal @ t) / sine, np.cross(second, back) / sine[:, None], normal / sine[:, None]


def _median_px(rays: F64, R: F64, t: F64, focal_px: float) -> float:
    return float(np.median(np.abs(_distances(rays, R, t)[0]))) * focal_px


def _refined(rays: F64, R: F64, t: F64) -> tuple[F64, F64]:
    """Return the turn and the direction with the smallest distances; Gauss-Newton with robust weights."""
    for _ in range(_ROUNDS):
        off, by_turn, by_t = _distances(rays, R, t)
        usual = max(1.4826 * float(np.median(np.abs(off))), 1e-6)
        weight = np.minimum(1.0, 1.5 * usual / np.maximum(np.abs(off), 1e-12)) ** 2
        basis = np.linalg.svd(t[None])[2][1:].T  # (3, 2)
        J = np.concatenate([by_turn, by_t @ basis], axis=1)
        H = J.T @ (weight[:, None] * J)
        step = -np.linalg.solve(H + 1e-6 * np.trace(H) * np.eye(5), J.T @ (weight * off))
        step /= max(1.0, float(np.abs(step).max()) / 0.1)
        R = R @ so3.to_matrix(so3.exp(step[:3]))
        t = t + basis @ step[3:]
        t = t / np.linalg.norm(t)
    return R, t
