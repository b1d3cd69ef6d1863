"""Depth of rectified stereo images by OpenCV's block matching."""

import dataclasses
import math
from typing import Any

import numpy as np

from maplab_py.algorithms.dense.options import BmOptions, SgbmOptions, StereoOptions, check_matcher
from maplab_py.algorithms.dense.rectification import StereoPair
from maplab_py.array_types import F32, U8
from maplab_py.errors import UserError

_SUBPIXELS = 16.0
"""OpenCV's disparities are multiples of a sixteenth of a pixel."""
_MIN_DISPARITY_PX = 0.5
_MARGIN = 1.25
"""Surfaces are a little nearer than the landmarks on them."""
_LARGEST_SHARE = 0.4
"""Of the width: beyond, the images of both cameras have less than the rest in common."""
_NO_CHECK = -1
_SURFACE_SIGMA_PX, _APART_PX = 1.0, -100.0
"""Disparities that differ by much more are of other surfaces; a value that differs from all."""
_STEP_M, _STEP_SHARE = 0.05, 0.1
"""A difference of depths in a window that is a step: this much, and this part of the depth."""


class DepthMatcher:
    """Computes the depth of rectified images of one pair of cameras."""

    def __init__(
        self,
        pair: StereoPair,
        stereo: StereoOptions,
        sgbm: SgbmOptions,
        bm: BmOptions,
        near_m: float = float("inf"),
    ) -> None:
        """Prepare the matcher.

        Args:
            near_m: Depth of the nearest surfaces of the scene; infinite where it is not known.

        Raises:
            UserError: An option is out of range.
        """
        self.pair = pair
        self._median_window = stereo.median_window
        self._bilateral_window = stereo.bilateral_window
        matcher: SgbmOptions | BmOptions = sgbm if stereo.use_sgbm else bm
        if stereo.adapt_params_to_image_size:
            count = _disparities(pair, near_m) - matcher.min_disparity
            matcher = dataclasses.replace(matcher, num_disparities=max(16, (count + 15) & -16))
        if not stereo.depth_check:
            matcher = dataclasses.replace(matcher, disp12_max_diff=_NO_CHECK)
        try:
            check_matcher(matcher)
        except ValueError as error:
            raise UserError(str(error)) from None
        self.disparities_px = matcher.num_disparities
        self._padding = matcher.min_disparity + matcher.num_disparities
        self.nearest_m = pair.pinhole.focal_px * pair.baseline_m / max(self._padding, 1)
        self._matcher = _opencv_matcher(matcher)

    def depth(self, left: U8, right: U8) -> F32:
        """Return the depths (H, W) [m] of the rectified left image; 0 = unknown.

        Args:
            left: Recorded image (H, W) of the left camera.
            right: Recorded image of the right camera.
        """
        import cv2

        pair = self.pair
        images = [pair.to_left.image(left), pair.to_right.image(right)]
        # OpenCV leaves out as many columns on the left as there are disparities
        padded = [
            cv2.copyMakeBorder(image, 0, 0, self._padding, 0, cv2.BORDER_REPLICATE)
            for image in images
        ]
        disparity = self._matcher.compute(*padded)[:, self._padding :].astype(np.float32)
        disparity /= np.float32(_SUBPIXELS)
        disparity = self._smooth(disparity)
        columns = np.arange(disparity.shape[1], dtype=np.float32)
        known = (disparity > _MIN_DISPARITY_PX) & (columns >= disparity) & pair.valid
        focal_baseline = np.float32(pair.pinhole.focal_px * pair.baseline_m)
        depth = focal_baseline / np.maximum(disparity, np.float32(_MIN_DISPARITY_PX))
        return np.where(known, depth, np.float32(0.0))

    def _smooth(self, disparity: F32) -> F32:
        """Filter the disparities (H, W) on surfaces; those that are not known stay below zero."""
        import cv2

        known = disparity > 0.0
        if self._median_window:
            median = cv2.medianBlur(np.maximum(disparity, 0.0), self._median_window)
            disparity = np.where(known, median, disparity)
        if self._bilateral_window:
            apart = np.where(known, disparity, np.float32(_APART_PX))
            smooth = cv2.bilateralFilter(
                apart, self._bilateral_window, _SURFACE_SIGMA_PX, 0.45 * self._bilateral_window
            )
            disparity = np.where(known, smooth, disparity)
        return np.asarray(disparity, dtype=np.float32)


def _disparities(pair: StereoPair, near_m: float) -> int:
    """Return the largest disparity [px]: maplab's eighth of the width, or more for near surfaces."""
    width = pair.pinhole.width_px
    wanted = _MARGIN * pair.pinhole.focal_px * pair.baseline_m / max(near_m, 1e-3)
    return max(width // 8, min(math.ceil(wanted), round(_LARGEST_SHARE * width)))


def without_edges(depth: F32, margin_px: int) -> F32:
    """Remove the depths (H, W) [m] within some pixels of a step: matched blocks lie on both sides."""
    import cv2

    if margin_px == 0:
        return depth
    window = np.ones((2 * margin_px + 1, 2 * margin_px + 1), dtype=np.uint8)
    farthest = cv2.dilate(depth, window)
    nearest = cv2.erode(np.where(depth > 0.0, depth, np.float32(np.inf)), window)
    is_step = farthest - nearest > _STEP_M + _STEP_SHARE * depth
    return np.where(is_step, np.float32(0.0), depth)


def _opencv_matcher(options: SgbmOptions | BmOptions) -> Any:
    """Return OpenCV's matcher; its setters have the names of the options in camel case."""
    import cv2

    is_sobel = isinstance(options, BmOptions) and options.prefilter_type == "xsobel"
    values = dataclasses.asdict(options)
    values["block_size"] = values.pop("sad_window_size")
    if values.pop("prefilter_type", None) is not None:
        response = cv2.StereoBM_PREFILTER_NORMALIZED_RESPONSE
        values["pre_filter_type"] = cv2.StereoBM_PREFILTER_XSOBEL if is_sobel else response
    matcher = (cv2.StereoBM if isinstance(options, BmOptions) else cv2.StereoSGBM).create()
    for name, value in values.items():
        getattr(matcher, "set" + "".join(map(str.capitalize, name.split("_"))))(value)
    return matcher
