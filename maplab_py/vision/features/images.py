"""Preparation of images: checks, size, contrast, and masks."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.array_types import F64, U8
from maplab_py.errors import MapError, UserError, os_errors_as
from maplab_py.input_files import read_bytes
from maplab_py.sensors import Camera
from maplab_py.vision.features.options import FeatureOptions

_MAX_MASK_BYTES = 100_000_000
_MASK_THRESHOLD = 128
"""Grey value from which a pixel of a mask may be used."""


@dataclasses.dataclass(frozen=True, eq=False)
class ImagePreparation:
    """Makes images of one camera ready; its images have their own, resized pixels."""

    camera: Camera
    number: int  # of the camera in the rig, for messages
    scale: F64  # (2,) prepared pixels per recorded pixel, horizontally and vertically
    size: tuple[int, int]  # (width, height) of prepared images
    usable: U8  # (height, width) 255 where keypoints may be, 0 elsewhere
    equaliser: Any  # OpenCV's CLAHE, or None

    @classmethod
    def of(cls, camera: Camera, number: int, options: FeatureOptions) -> ImagePreparation:
        """Prepare for a camera.

        Raises:
            UserError: The mask cannot be read or has another size than the camera's images.
        """
        import cv2

        factor, recorded = (
            options.image_resize_factor,
            np.array([camera.width_px, camera.height_px]),
        )
        width, height = np.maximum(np.round(factor * recorded), 1).astype(int).tolist()
        usable = np.zeros((height, width), dtype=np.uint8)
        margin = max(round(options.min_tracking_distance_to_image_border_px * factor), 4)
        usable[margin : height - margin, margin : width - margin] = 255
        mask = _mask(camera, number, options)
        if mask is not None:
            usable &= cv2.resize(mask, (width, height), interpolation=cv2.INTER_NEAREST)
        equaliser = None
        if options.apply_clahe:
            tiles = options.clahe_grid_size
            equaliser = cv2.createCLAHE(float(options.clahe_clip_limit), (tiles, tiles))
        scale = np.array([width, height]) / recorded
        return cls(camera, number, scale, (width, height), usable, equaliser)

    def prepare(self, image: U8) -> U8:
        """Return the image ready for detection and tracking.

        Raises:
            MapError: It is not an 8-bit grey image of the size that the camera was calibrated for.
        """
        import cv2

        expected = self.camera.height_px, self.camera.width_px
        if image.shape != expected or image.dtype != np.uint8:
            shape = " x ".join(str(side) for side in image.shape[::-1])
            raise MapError(
                f"camera {self.number}: an image of {shape} pixels of type {image.dtype}; wants "
                f"8-bit grey, {expected[1]} x {expected[0]}, as the camera was calibrated"
            )
        if self.size == (self.camera.width_px, self.camera.height_px):
            prepared = np.array(image, order="C")  # a driver may use its memory again
        else:
            shrinks = self.size[0] < self.camera.width_px
            method = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
            prepared = np.asarray(cv2.resize(image, self.size, interpolation=method))
        if self.equaliser is not None:
            prepared = self.equaliser.apply(prepared)
        return np.asarray(prepared, dtype=np.uint8)

    def to_recorded(self, uv: F64) -> F64:
        """Return recorded pixels (K, 2) of prepared ones; pixel centres have whole numbers."""
        return np.asarray((uv + 0.5) / self.scale - 0.5)

    def to_prepared(self, uv_px: F64) -> F64:
        """Return prepared pixels (K, 2) of recorded ones."""
        return np.asarray((uv_px + 0.5) * self.scale - 0.5)


def _mask(camera: Camera, number: int, options: FeatureOptions) -> U8 | None:
    """Return the mask of a camera, 255 where it may be used; None when there is none."""
    import cv2

    names = [name.strip() for name in options.image_mask_path.split(",")]
    if len(names) > 1:  # a single mask is for all cameras
        names = [*names, *[""] * (number + 1)][number : number + 1]
    name = names[0]
    if not name:
        return None
    with os_errors_as(UserError, f"--rovio_image_mask_path: {name} cannot be read"):
        data = read_bytes(Path(name), _MAX_MASK_BYTES, remedy="it is no image", error=UserError)
    image = (
        cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_GRAYSCALE) if data else None
    )
    if image is None:
        raise UserError(f"--rovio_image_mask_path: {name} is no image: give a PNG file")
    if image.shape != (camera.height_px, camera.width_px):
        raise UserError(
            f"--rovio_image_mask_path: {name} has {image.shape[1]} x {image.shape[0]} pixels, the "
            f"images of camera {number} have {camera.width_px} x {camera.height_px}"
        )
    return np.where(image >= _MASK_THRESHOLD, 255, 0).astype(np.uint8)
