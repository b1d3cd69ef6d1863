"""Views of the cameras of a rig for tracking: prepared pixels, rays, and overlaps."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.array_types import F64, U8, Mask
from maplab_py.compilation import compiled
from maplab_py.geometry import so3
from maplab_py.sensors import Camera
from maplab_py.sensors.projection import back_project, is_inside_image, project
from maplab_py.vision.features.images import ImagePreparation
from maplab_py.vision.features.options import FeatureOptions
from maplab_py.vision.tracking.ray_table import RayTable

_MIN_OVERLAP = 0.2
"""Share of an image that another camera must see, too, for stereo."""
_GRID_PX = 8


@dataclasses.dataclass(frozen=True, eq=False)
class CameraView:
    """One camera; uv are pixels of its prepared images."""

    camera: Camera
    preparation: ImagePreparation
    R_I_C: F64  # (3, 3)
    p_I_C: F64  # (3,)
    focal_px: float  # recorded pixels per radian at the principal point
    table: RayTable

    @classmethod
    def of(cls, camera: Camera, number: int, T_I_C: F64, options: FeatureOptions) -> CameraView:
        """Prepare for a camera with pose T_I_C (7,) on the IMU."""
        return cls(
            camera,
            ImagePreparation.of(camera, number, options),
            so3.to_matrix(T_I_C[:4]),
            np.array(T_I_C[4:]),
            focal_length_px(camera),
            RayTable.of(camera),
        )

    def rays(self, uv: F64) -> tuple[F64, Mask]:
        """Return unit rays (K, 3) and whether they exist."""
        return self.table.rays(self.preparation.to_recorded(uv))

    def pixels(self, p_C: F64) -> tuple[F64, Mask]:
        """Return pixels (K, 2) of points (K, 3) or rays, and whether they are visible."""
        uv_px, visible = project(self.camera, p_C)
        return self.preparation.to_prepared(uv_px), visible

    def is_usable(self, uv: F64) -> Mask:
        """Tell which pixels (K, 2) lie where keypoints may be."""
        result: Mask = np.empty(len(uv), dtype=np.bool_)
        _find_usable(self.preparation.usable, uv, result)
        return result


@compiled()
def _find_usable(usable, uv, result):  # type: ignore[no-untyped-def]
    """Fill in (K,) whether the nearest pixels of uv (K, 2) are usable."""
    height, width = usable.shape
    for k in range(len(uv)):
        u, v = np.rint(uv[k, 0]), np.rint(uv[k, 1])
        inside = 0.0 <= u < width and 0.0 <= v < height
        result[k] = inside and usable[int(v), int(u)] > 0


def focal_length_px(camera: Camera) -> float:
    """Return the pixels per radian at the principal point, undistorted."""
    return float(np.mean(camera.central_focal_px))


def leaders(views: tuple[CameraView, ...], absent: frozenset[int] = frozenset()) -> list[int]:
    """Return for each camera the camera whose tracks it takes over, itself if there is none.

    It is the first camera that leads itself and sees enough of the image. Absent ones lead nobody.
    """
    result: list[int] = []
    for row, view in enumerate(views):
        earlier = (first for first in range(row) if result[first] == first)
        candidates = [first for first in earlier if not {first, row} & absent]
        shared = (c for c in candidates if float(np.mean(seen_by(view, views[c]))) >= _MIN_OVERLAP)
        result.append(next(shared, row))
    return result


def seen_by(view: CameraView, other: CameraView) -> Mask:
    """Return where the image of a camera shows what another sees far away, on a coarse grid."""
    width, height = view.camera.width_px, view.camera.height_px
    v, u = np.mgrid[_GRID_PX // 2 : height : _GRID_PX, _GRID_PX // 2 : width : _GRID_PX]
    ray, exists = back_project(view.camera, np.stack([u, v], axis=-1).astype(np.float64))
    uv_px, visible = project(other.camera, ray @ (other.R_I_C.T @ view.R_I_C).T)
    return np.asarray(exists & visible & is_inside_image(other.camera, uv_px, _GRID_PX))


def usable_alone(view: CameraView, leader: CameraView) -> U8:
    """Return the usable pixels of a camera's prepared image that its leader does not see."""
    import cv2

    seen = seen_by(view, leader).astype(np.uint8)
    mask = cv2.resize(seen, view.preparation.size, interpolation=cv2.INTER_NEAREST)
    return np.where(mask > 0, 0, view.preparation.usable).astype(np.uint8)
