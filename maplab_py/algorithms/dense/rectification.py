"""Stereo pairs of a rig, and their rectification for every camera model.

A rectified image is perspective, with its x axis along the baseline. It is sampled through the
project's own camera models, so that equidistant, FOV and unified cameras work as pinhole cameras do.
Source: Fusiello et al., A compact algorithm for rectification of stereo pairs, 2000.
"""

import dataclasses

import numpy as np

from maplab_py.algorithms.dense import pinhole as pinholes
from maplab_py.array_types import F32, F64, Mask
from maplab_py.geometry import se3
from maplab_py.sensors import CameraRig, projection


@dataclasses.dataclass(frozen=True, eq=False)
class StereoPair:
    """Two cameras of a rig, rectified.

    P is the frame of the rectified left camera: at the left camera, x towards the right camera.
    """

    left: int  # index of the camera in its rig
    right: int
    baseline_m: float
    pinhole: pinholes.Pinhole
    R_C_P: F64  # (3, 3) of the left camera
    to_left: pinholes.ImageMap  # where rectified pixels lie in the left image
    to_right: pinholes.ImageMap
    from_left: pinholes.ImageMap  # where pixels of the left image lie in the rectified one
    depth_factor: F32  # (H, W) depth along the left camera's axis per depth along P's

    @property
    def valid(self) -> Mask:
        """Rectified pixels (H, W) that are inside the left image."""
        return self.to_left.valid

    def depth_of_left(self, depth_P: F32) -> F32:
        """Return rectified depths as a depth map of the left camera's own, distorted image."""
        return np.asarray(self.from_left.depth(depth_P) * self.depth_factor, dtype=np.float32)


def stereo_pairs(
    rig: CameraRig, *, min_baseline_m: float, max_angle_rad: float, scale: float = 1.0
) -> tuple[list[StereoPair], list[str]]:
    """Rectify the pairs of cameras that are suitable for stereo.

    Args:
        min_baseline_m: Smallest distance.
        max_angle_rad: Largest angle between the optical axes.
        scale: Size of rectified images, as a fraction of the left camera's.

    Returns:
        The pairs, and for each other pair why it is left out.
    """
    pairs, reasons = [], []
    for a in range(len(rig.cameras)):
        for b in range(a + 1, len(rig.cameras)):
            reason = _unsuitable(rig, a, b, min_baseline_m, max_angle_rad)
            if reason:
                reasons.append(f"cameras {a} and {b}: {reason}")
            else:
                left, right = _order(rig, a, b)
                pairs.append(_rectify(rig, left, right, scale))
    return pairs, reasons


def _unsuitable(rig: CameraRig, a: int, b: int, min_baseline_m: float, max_angle_rad: float) -> str:
    """Return why two cameras are no stereo pair, empty if they are."""
    p_a_b = se3.relative(rig.T_B_C[a], rig.T_B_C[b])[4:]
    baseline_m = float(np.linalg.norm(p_a_b))
    if baseline_m < min_baseline_m:
        return f"baseline {baseline_m:.3f} m is below --dense_stereo_min_baseline"
    axes = [se3.to_matrix(rig.T_B_C[camera])[:3, 2] for camera in (a, b)]
    angle = float(np.arccos(np.clip(axes[0] @ axes[1], -1.0, 1.0)))
    if angle > max_angle_rad:
        return f"angle {angle:.3f} rad exceeds --dense_stereo_max_angle_between_opt_axes"
    for first, second in ((a, b), (b, a)):
        direction = se3.relative(rig.T_B_C[first], rig.T_B_C[second])[4:] / baseline_m
        uv, visible = projection.project(rig.cameras[first], np.stack([direction, -direction]))
        if np.any(visible & projection.is_inside_image(rig.cameras[first], uv)):
            return f"the epipole is inside the image of camera {first}"
    return ""


def _order(rig: CameraRig, a: int, b: int) -> tuple[int, int]:
    """Return the left and the right camera; of two above each other the upper is the left one."""
    p_a_b = se3.relative(rig.T_B_C[a], rig.T_B_C[b])[4:]
    main = int(np.argmax(np.abs(p_a_b[:2])))
    return (a, b) if p_a_b[main] > 0.0 else (b, a)


def _rectify(rig: CameraRig, left: int, right: int, scale: float) -> StereoPair:
    T_left, T_right = (se3.to_matrix(rig.T_B_C[camera]) for camera in (left, right))
    baseline = T_right[:3, 3] - T_left[:3, 3]
    baseline_m = float(np.linalg.norm(baseline))
    x = baseline / baseline_m
    axis = T_left[:3, 2] + T_right[:3, 2]
    z = axis - (axis @ x) * x
    z /= np.linalg.norm(z)
    R_B_P = np.stack([x, np.cross(z, x), z], axis=1)
    R_C_P = [T[:3, :3].T @ R_B_P for T in (T_left, T_right)]
    cameras = [rig.cameras[left], rig.cameras[right]]
    is_upright = abs(R_C_P[0][0, 0]) >= abs(R_C_P[0][1, 0])
    sizes = (cameras[0].width_px, cameras[0].height_px)
    width, height = (round(scale * size) for size in (sizes if is_upright else sizes[::-1]))
    views = [(camera, R.T) for camera, R in zip(cameras, R_C_P, strict=True)]
    pinhole = pinholes.inscribed(views, width, height)
    from_left, factor = pinholes.map_from_camera(pinhole, cameras[0], R_C_P[0])
    to_left, to_right = (
        pinholes.map_to_camera(pinhole, camera, R) for camera, R in zip(cameras, R_C_P, strict=True)
    )
    return StereoPair(
        left, right, baseline_m, pinhole, R_C_P[0], to_left, to_right, from_left, factor
    )


def pinhole_pose(pair: StereoPair, T_G_C: F64) -> F64:
    """Return the pose T_G_P (4, 4) of a rectified image of the left camera at T_G_C (7,)."""
    T = se3.to_matrix(T_G_C)
    T[:3, :3] = T[:3, :3] @ pair.R_C_P
    return np.asarray(T)
