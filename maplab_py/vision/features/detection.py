"""Detection of keypoints on a grid (Schneider 2019, Paper I, section 3.1).

Corners pass the segment test of FAST or AGAST; the strongest of every cell that keep their
distance from tracked keypoints and from each other are taken. The strength is that of a corner for
Lucas-Kanade, not the response of the segment test: it tells corners from edges.
"""

from typing import Any, NamedTuple

import numpy as np

from maplab_py.array_types import F64, I64, U8, Mask
from maplab_py.compilation import compiled
from maplab_py.vision.features.options import FeatureOptions

WINDOW_HALF_PX = 3
"""Half the side of the window in which a corner's gradients count."""
_CLIMB_PX = 3
"""Farthest that a corner is moved to the strongest place near it, in each direction."""


class Selection(NamedTuple):
    """Constraints on a choice of corners; changed by `select_corners`."""

    free: U8  # (H, W) not zero where a corner may be
    cell_count: I64  # (rows, columns) keypoints of each cell
    cell_limit: int
    limit: int  # most new corners
    radius_px: float


@compiled()
def corner_strengths(image, uv, strength):  # type: ignore[no-untyped-def]
    """Fill in the smaller eigenvalue of the mean outer product of gradients about each corner.

    Source: J. Shi, C. Tomasi, Good Features to Track, CVPR 1994. Corners too near to the border
    get 0.

    Args:
        image: Grey values (H, W).
        uv: Whole pixels (N, 2).
        strength: Filled in (N,), [grey^2 / px^2].
    """
    height, width = image.shape
    reach = WINDOW_HALF_PX + 1
    samples = (2 * WINDOW_HALF_PX + 1) ** 2
    for n in range(len(uv)):
        u, v = uv[n, 0], uv[n, 1]
        strength[n] = 0.0
        if u < reach or v < reach or u >= width - reach or v >= height - reach:
            continue
        xx, xy, yy = np.int64(0), np.int64(0), np.int64(0)
        for row in range(v - WINDOW_HALF_PX, v + WINDOW_HALF_PX + 1):
            for column in range(u - WINDOW_HALF_PX, u + WINDOW_HALF_PX + 1):
                dx = np.int64(image[row, column + 1]) - np.int64(image[row, column - 1])
                dy = np.int64(image[row + 1, column]) - np.int64(image[row - 1, column])
                xx += dx * dx
                xy += dx * dy
                yy += dy * dy
        mean, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
        # central differences span two pixels
        strength[n] = (mean - np.sqrt(half * half + float(xy) * xy)) / (4.0 * samples)


@compiled()
def climb_to_corners(image, uv, place):  # type: ignore[no-untyped-def]
    """Fill in the local maximum of the corner strength in windows of 3 x 3 pixels, near each corner.

    Corners near to the border stay where they are.

    Args:
        image: Grey values (H, W).
        uv: Whole pixels (N, 2).
        place: Filled in (N, 2), interpolated by parabolas.
    """
    height, width = image.shape
    reach = _CLIMB_PX + 3
    near = np.empty((3, 3))
    for n in range(len(uv)):
        u, v = uv[n, 0], uv[n, 1]
        place[n, 0], place[n, 1] = u, v
        if u < reach or v < reach or u >= width - reach or v >= height - reach:
            continue
        for _ in range(_CLIMB_PX):
            best_u, best_v = u, v
            strongest = _strength_3(image, u, v)
            for dv in range(-1, 2):
                for du in range(-1, 2):
                    strength = _strength_3(image, u + du, v + dv)
                    if strength > strongest:
                        strongest, best_u, best_v = strength, u + du, v + dv
            if best_u == u and best_v == v:
                break
            u, v = best_u, best_v
        for dv in range(-1, 2):
            for du in range(-1, 2):
                near[dv + 1, du + 1] = _strength_3(image, u + du, v + dv)
        place[n, 0] = u + _summit(near[1, 0], near[1, 1], near[1, 2])
        place[n, 1] = v + _summit(near[0, 1], near[1, 1], near[2, 1])


@compiled()
def _strength_3(image, u, v):  # type: ignore[no-untyped-def]
    """Return the smaller eigenvalue of the sum of outer products of Sobel gradients over 3 x 3 pixels."""
    xx, xy, yy = np.int64(0), np.int64(0), np.int64(0)
    for row in range(v - 1, v + 2):
        for column in range(u - 1, u + 2):
            dx, dy = np.int64(0), np.int64(0)
            for k in range(-1, 2):
                weight = 2 - abs(k)
                right, left = image[row + k, column + 1], image[row + k, column - 1]
                below, above = image[row + 1, column + k], image[row - 1, column + k]
                dx += weight * (np.int64(right) - np.int64(left))
                dy += weight * (np.int64(below) - np.int64(above))
            xx += dx * dx
            xy += dx * dy
            yy += dy * dy
    mean, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
    return mean - np.sqrt(half * half + float(xy) * xy)


@compiled()
def _summit(before, here, after):  # type: ignore[no-untyped-def]
    """Return where the parabola through values at -1, 0, 1 is largest, within half a step."""
    curvature = 2.0 * here - before - after
    if not curvature > 0.0:
        return 0.0
    return min(max(0.5 * (after - before) / curvature, -0.5), 0.5)


@compiled()
def occupy(free, u, v, radius_px):  # type: ignore[no-untyped-def]
    """Set the disc about a pixel to zero."""
    height, width = free.shape
    reach = int(radius_px)
    for row in range(max(v - reach, 0), min(v + reach + 1, height)):
        half = int(np.sqrt(radius_px * radius_px - (row - v) ** 2))
        free[row, max(u - half, 0) : max(min(u + half + 1, width), 0)] = 0


@compiled()
def occupy_all(selection, uv):  # type: ignore[no-untyped-def]
    """Count keypoints uv (K, 2), whole pixels, that exist already; others keep away from them."""
    height, width = selection.free.shape
    rows, columns = selection.cell_count.shape
    for k in range(len(uv)):
        u, v = uv[k, 0], uv[k, 1]
        occupy(selection.free, u, v, selection.radius_px)
        if 0 <= u < width and 0 <= v < height:
            selection.cell_count[v * rows // height, u * columns // width] += 1


@compiled()
def select_corners(selection, uv, order, is_selected):  # type: ignore[no-untyped-def]
    """Mark corners, in the given order, that lie in free places of cells that have room."""
    height, width = selection.free.shape
    rows, columns = selection.cell_count.shape
    count = 0
    for n in order:
        if count >= selection.limit:
            break
        u, v = uv[n, 0], uv[n, 1]
        row, column = v * rows // height, u * columns // width
        if selection.free[v, u] == 0 or selection.cell_count[row, column] >= selection.cell_limit:
            continue
        is_selected[n] = True
        selection.cell_count[row, column] += 1
        occupy(selection.free, u, v, selection.radius_px)
        count += 1
    return count


@compiled()
def _find_apart(uv, others, distance_px, is_after, is_apart):  # type: ignore[no-untyped-def]
    """Fill in (K,) whether no other keypoint (L, 2), or none before it, is within a distance."""
    for k in range(len(uv)):
        is_apart[k] = True
        for other in range(k if is_after else len(others)):
            du, dv = uv[k, 0] - others[other, 0], uv[k, 1] - others[other, 1]
            if np.sqrt(du * du + dv * dv) <= distance_px:
                is_apart[k] = False
                break


def are_apart(uv: F64, others_uv: F64, distance_px: float) -> Mask:
    """Tell which keypoints (K, 2) are farther than a distance from all others (L, 2)."""
    is_apart: Mask = np.empty(len(uv), dtype=np.bool_)
    _find_apart(uv, others_uv, distance_px, False, is_apart)
    return is_apart


def are_apart_before(uv: F64, distance_px: float) -> Mask:
    """Tell which keypoints (K, 2) are farther than a distance from all before them."""
    is_apart: Mask = np.empty(len(uv), dtype=np.bool_)
    _find_apart(uv, uv, distance_px, True, is_apart)
    return is_apart


def strengths(image: U8, uv: I64) -> F64:
    """Return the strengths (N,) of corners at whole pixels (N, 2); see `corner_strengths`."""
    strength = np.empty(len(uv))
    corner_strengths(image, uv, strength)
    return strength


def strongest_places(image: U8, uv: I64) -> F64:
    """Return the strongest places (N, 2) near corners at whole pixels (N, 2); see `climb_to_corners`."""
    place = np.empty((len(uv), 2))
    climb_to_corners(image, uv, place)
    return place


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
        self._part = _bounds(usable)
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
        count: I64 = np.zeros(self._cells, dtype=np.int64)
        selection = Selection(self._usable.copy(), count, limit, 0, self._radius_px)
        occupy_all(selection, np.round(tracked_uv).astype(np.int64))
        selected = _select(image, self._corners(self._detector, image, self._part), selection, room)
        room -= len(selected)
        if room <= 0:
            return np.asarray(selected, dtype=np.float64)
        poor = selection.cell_count < 0.5 * self._equal_share
        cells = [self._cell(row, column) for row, column in np.argwhere(poor).tolist()]
        cells = [cell for cell in cells if np.mean(selection.free[cell] > 0) >= _MIN_FREE_SHARE]
        if cells:
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

    def _corners(self, detector: Any, image: U8, part: tuple[slice, slice]) -> I64:
        """Return the corners (N, 2), whole pixels, of a part of an image."""
        import cv2

        reach = _SEGMENT_TEST_REACH_PX + 1  # non-maximum suppression compares neighbours
        u0, v0 = max(part[1].start - reach, 0), max(part[0].start - reach, 0)
        u1 = min(part[1].stop + reach, image.shape[1])
        v1 = min(part[0].stop + reach, image.shape[0])
        keypoints = detector.detect(image[v0:v1, u0:u1])
        if not keypoints:
            return np.zeros((0, 2), dtype=np.int64)
        library: Any = cv2
        uv = np.asarray(library.KeyPoint_convert(keypoints)) + np.array([u0, v0])
        return np.asarray(np.round(uv), dtype=np.int64)


def _bounds(usable: U8) -> tuple[slice, slice]:
    """Return the rows and columns of an image that have usable pixels."""
    rows, columns = (np.flatnonzero(usable.any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return slice(0, 0), slice(0, 0)
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


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
