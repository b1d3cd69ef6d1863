"""Pictures of vertices: their images and depth maps, from the map's resources."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from maplab_py.array_types import U8
from maplab_py.errors import MapError
from maplab_py.storage.resources import ResourceStore
from maplab_py.viewer import colours
from maplab_py.viewer.resource_clouds import type_number
from maplab_py.vimap import ResourceOwner, VIMap

IMAGE_TYPES = (
    "raw_images", "raw_color_images", "undistorted_images", "undistorted_color_images",
    "rectified images", "rectified_color_images",
)  # fmt: skip
"""Types that show what a camera saw, the preferred first."""
DEPTH_TYPES = ("optimized_depth_maps", "raw_depth_maps")
"""Types of depth, the preferred first."""
_MM = 1e-3


class VertexImages:
    """The images of vertices, from the map's resources."""

    def __init__(
        self, vi_map: VIMap, folder: Path, name: str = "", *, with_depth: bool = False
    ) -> None:
        """Find the images of a type.

        Args:
            vi_map: Map.
            folder: Its folder.
            name: Type; empty = the first type of images that the map has.
            with_depth: Show the depth map of a vertex below its image.
        """
        self._store = ResourceStore(vi_map, folder)
        self._row_of_vertex = _first_of_vertices(vi_map, (name,) if name else IMAGE_TYPES)
        self._frame_of_row = vi_map.resources.owner
        self._depth_of_vertex: dict[int, int] = {}
        if with_depth:
            self._depth_of_vertex = _first_of_vertices(vi_map, DEPTH_TYPES)

    def __len__(self) -> int:
        return len(self._row_of_vertex.keys() | self._depth_of_vertex.keys())

    def __call__(self, vertex: int) -> U8 | None:
        """Return the picture (H, W, 3) RGB of a vertex (row), None when it has none that can be read."""
        image = self.image(vertex)
        depth = self._load(self._depth_of_vertex.get(vertex))
        parts = [] if image is None else [image]
        if depth is not None and depth.ndim == 2:
            parts.append(depth_picture(depth, parts[0].shape[1] if parts else depth.shape[1]))
        return np.concatenate(parts) if parts else None

    def image(self, vertex: int) -> U8 | None:
        """Return the image (H, W, 3) RGB of a vertex (row) without its depth."""
        image = self._load(self._row_of_vertex.get(vertex))
        return None if image is None else as_rgb(image)

    def frame(self, vertex: int) -> int:
        """Return the frame (row) that the image of a vertex (row) belongs to, -1 = it has none."""
        row = self._row_of_vertex.get(vertex)
        return -1 if row is None else int(self._frame_of_row[row])

    def _load(self, row: int | None) -> U8 | None:
        if row is None:
            return None
        try:
            return np.asarray(self._store.load(row))
        except MapError:
            return None


def _first_of_vertices(vi_map: VIMap, names: tuple[str, ...]) -> dict[int, int]:
    """Return the first resource (row) of every vertex (row), of the first type that the map has."""
    owned = vi_map.resources.owner_kind == ResourceOwner.FRAME
    for name in names:
        rows = np.flatnonzero(owned & (vi_map.resources.type == type_number(name)))
        if len(rows):
            vertices = vi_map.frames.vertex[vi_map.resources.owner[rows]]
            return dict(zip(vertices.tolist()[::-1], rows.tolist()[::-1], strict=True))
    return {}


def depth_picture(depth_mm: NDArray[np.uint8] | NDArray[np.uint16], width_px: int) -> U8:
    """Return a depth map (H, W) [mm] in colours (h, width_px, 3), with its range; unknown is black."""
    import cv2

    known = depth_mm > 0
    z = np.where(known, depth_mm, 1).astype(np.float64)
    low, high = np.percentile(z[known], [1.0, 99.0]) if known.any() else (1.0, 1.0)
    part = (z - low) / max(high - low, 1.0)
    picture = np.where(known[..., None], colours.ramp(part, colours.SEQUENTIAL[::-1]), 0)
    size = width_px, max(1, round(depth_mm.shape[0] * width_px / depth_mm.shape[1]))
    picture = cv2.resize(picture.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    text = f"depth {low * _MM:.2g} to {high * _MM:.2g} m" if known.any() else "no depth"
    scale = width_px / 700.0
    place = round(12 * scale), round(28 * scale)
    for colour, thickness in (((0, 0, 0), 4.0), ((255, 255, 255), 1.5)):
        line = max(1, round(thickness * scale))
        cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, line)
    return np.asarray(picture, dtype=np.uint8)


def as_rgb(image: NDArray[np.uint8] | NDArray[np.uint16]) -> U8:
    """Return an image (H, W[, 3] BGR), depths included, as RGB (H, W, 3)."""
    if image.dtype != np.uint8:
        largest = max(float(image.max(initial=0)), 1.0)
        image = np.round(image / largest * 255.0).astype(np.uint8)
    if image.ndim == 2:
        return np.repeat(image[:, :, None], 3, axis=2).astype(np.uint8)
    return np.ascontiguousarray(image[:, :, 2::-1], dtype=np.uint8)
