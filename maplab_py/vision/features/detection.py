"""Detection of keypoints on a grid (Schneider 2019, Paper I, section 3.1).

Corners pass the segment test of FAST or AGAST; the strongest of every cell that keep their
distance from tracked keypoints and from each other are taken. The strength is that of a corner for
Lucas-Kanade, not the response of the segment test: it tells corners from edges.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from maplab_py.array_types import F64, I64, U8
from maplab_py.vision.features.corner_kernels import (
    Selection,
    make_selection,
    occupy_all,
    select_corners,
    strengths,
    strongest_places,
)
from maplab_py.vision.features.options import FeatureOptions

_MIN_STRENGTH = 4.0
"""Weakest corner [grey^2 / px^2]: gradients of 2 grey values per pixel in every direction."""
_SEGMENT_TEST_REACH_PX = 3
_MIN_FREE_SHARE = 0.1
"""Share of a cell that must be free for a second search in it."""
_REFINED_HALF_PX, _REFINED_ITERATIONS, _REFINED_END_PX = 2, 30, 0.005
_LARGEST_REFINEMENT_PX = 2.0


class GridDetector:
    """Detects new keypoints where an image has room for them."""

    def __init__(self, options: FeatureOptions, usable: U8) -> None:
        """Detect in images of the size of a mask (H, W) of usable pixels."""
        import cv2

        self._usable, self._options = usable, options
        factor = options.image_resize_factor
        self._radius_px = max(options.detector_nms_radius * factor, 1.0)
        library: Any = cv2
        make = library.FastFeatureDetector_create
        if options.detector_type == "agast":
            make = library.AgastFeatureDetector_create
        strong = options.detector_threshold
        self._detector = make(threshold=strong, nonmaxSuppression=True)
        self._sensitive = make(threshold=max(strong // 3, 1), nonmaxSuppression=True)
        rows = options.gridded_detector_num_grid_rows
        self._cells = rows, options.gridded_detector_num_grid_cols
        self._equal_share = options.detector_max_feature_count / (rows * self._cells[1])

    def detect(self, image: U8, tracked_uv: F64) -> F64:
        """Return new keypoints (N, 2), the strongest first, in pixels of the image.

        Args:
            image: Prepared image (H, W).
            tracked_uv: Keypoints (K, 2) that exist already.
        """
        options = self._options
        room = options.detector_max_feature_count - len(tracked_uv)
        if room <= 0:
            return np.zeros((0, 2))
        scaler = options.gridded_detector_cell_num_features_scaler
        limit = int(np.ceil(scaler * self._equal_share))
        selection = make_selection(self._usable, self._cells, limit, self._radius_px)
        occupy_all(selection, np.round(tracked_uv).astype(np.int64))
        selected = _select(image, self._corners(self._detector, image), selection, room)
        room -= len(selected)
        poor = selection.cell_count < 0.5 * self._equal_share
        cells = [self._cell(row, column) for row, column in np.argwhere(poor).tolist()]
        cells = [cell for cell in cells if np.mean(selection.free[cell] > 0) >= _MIN_FREE_SHARE]
        if room > 0 and cells:
            corners = [self._corners(self._sensitive, image, cell) for cell in cells]
            more = _select(image, np.concatenate(corners), selection, room)
            selected = np.concatenate([selected, more])
        return np.asarray(selected, dtype=np.float64)

    def _cell(self, row: int, column: int) -> tuple[slice, slice]:
        """Return the rows and columns of the image that belong to a cell."""
        height, width = self._usable.shape
        rows, columns = self._cells
        # a pixel belongs to cell floor(v rows / height)
        v0, v1 = -(-row * height // rows), -(-(row + 1) * height // rows)
        u0, u1 = -(-column * width // columns), -(-(column + 1) * width // columns)
        return slice(v0, v1), slice(u0, u1)

    def _corners(self, detector: Any, image: U8, cell: tuple[slice, slice] | None = None) -> I64:
        """Return the corners (N, 2), whole pixels, of an image or of a cell of it."""
        import cv2

        u0, u1, v0, v1 = 0, image.shape[1], 0, image.shape[0]
        if cell is not None:
            reach = _SEGMENT_TEST_REACH_PX + 1  # non-maximum suppression compares neighbours
            u0, v0 = max(cell[1].start - reach, 0), max(cell[0].start - reach, 0)
            u1, v1 = min(cell[1].stop + reach, u1), min(cell[0].stop + reach, v1)
        keypoints = detector.detect(image[v0:v1, u0:u1])
        if not keypoints:
            return np.zeros((0, 2), dtype=np.int64)
        library: Any = cv2
        uv = np.asarray(library.KeyPoint_convert(keypoints)) + np.array([u0, v0])
        return np.asarray(np.round(uv), dtype=np.int64)


def _select(image: U8, uv: I64, selection: Selection, room: int) -> I64:
    """Return the corners (N, 2) that are taken, the strongest first."""
    uv = uv[selection.free[uv[:, 1], uv[:, 0]] > 0]
    strength = strengths(image, uv)
    strong = strength >= _MIN_STRENGTH
    uv, strength = uv[strong], strength[strong]
    order = np.lexsort((uv[:, 0], uv[:, 1], -strength))
    is_selected = np.zeros(len(uv), dtype=np.bool_)
    select_corners(selection._replace(limit=room), uv, order, is_selected)
    return np.asarray(uv[order[is_selected[order]]], dtype=np.int64)


def refined(image: U8, uv: F64) -> F64:
    """Return corners (N, 2) moved to where the edges about them meet, in fractions of a pixel.

    The segment test finds a corner somewhere about its tip, at a whole pixel, so that two sessions would see
    two points a pixel apart. A corner climbs to the maximum of its strength in a small window, and from
    there to the point that the gradients about it are orthogonal to (W. Foerstner, E. Guelch, A Fast
    Operator for Detection and Precise Location of Distinct Points, 1987), if that is near.
    """
    import cv2

    if not len(uv):
        return uv
    strongest = strongest_places(image, np.round(uv).astype(np.int64))
    end: Any = cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS
    window, no_zone = (_REFINED_HALF_PX, _REFINED_HALF_PX), (-1, -1)
    met = cv2.cornerSubPix(
        image, strongest.astype(np.float32).reshape(-1, 1, 2), window, no_zone,
        (end, _REFINED_ITERATIONS, _REFINED_END_PX),
    )  # fmt: skip
    result = np.asarray(met.reshape(-1, 2), dtype=np.float64)
    near = np.linalg.norm(result - strongest, axis=1) <= _LARGEST_REFINEMENT_PX
    return np.where(near[:, None], result, strongest)
