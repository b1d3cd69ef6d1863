"""Options of tracking, with maplab's flag names where it has them."""

from __future__ import annotations

import math

from maplab_py.errors import FlagError
from maplab_py.options import option
from maplab_py.vision.features.options import FeatureOptions, check_range

_HALF_A_DEGREE = 1.0 - math.cos(math.radians(0.5))


class TrackingOptions(FeatureOptions, prefix="feature_tracking_"):
    """Detection of keypoints, tracking from image to image, and matching between cameras."""

    keypoint_sigma_px: float = 0.5
    """Standard deviation of a tracked keypoint"""
    patch_size_px: int = 15
    """Side of the patches that are compared"""
    pyramid_levels: int = 3
    """Levels of half resolution above the image"""
    forward_backward_px: float = 0.5
    """Largest error of a keypoint that is tracked forwards and back again"""
    two_pt_ransac_threshold: float = option(
        _HALF_A_DEGREE, flag="feature_tracker_two_pt_ransac_threshold"
    )
    """Two-point RANSAC: largest error of an inlier, as 1 - cos(angle)"""
    two_pt_ransac_max_iterations: int = option(
        200, flag="feature_tracker_two_pt_ransac_max_iterations"
    )
    """Two-point RANSAC: largest number of iterations"""
    epipolar_gate_px: float = 2.0
    """Largest distance of a keypoint to its epipolar line after the refinement of turn and direction, and
    between the cameras of a rig"""
    stereo_distance_m: float = 5.0
    """Distance at which other cameras look for a point of unknown distance"""

    def check(self) -> None:
        """Check the values.

        Raises:
            FlagError: A value is out of its range, or the descriptor is not available.
        """
        super().check()
        prefix = self.flag_prefix
        for flag, value, low, high in (
            (prefix + "keypoint_sigma_px", self.keypoint_sigma_px, 1e-3, 100),
            (prefix + "patch_size_px", self.patch_size_px, 3, 101),
            (prefix + "pyramid_levels", self.pyramid_levels, 0, 10),
            (prefix + "forward_backward_px", self.forward_backward_px, 1e-3, 100),
            ("feature_tracker_two_pt_ransac_threshold", self.two_pt_ransac_threshold, 1e-9, 0.5),
            (
                "feature_tracker_two_pt_ransac_max_iterations",
                self.two_pt_ransac_max_iterations,
                1,
                100_000,
            ),
            (prefix + "epipolar_gate_px", self.epipolar_gate_px, 1e-3, 1000),
            (prefix + "stereo_distance_m", self.stereo_distance_m, 1e-2, 1e6),
        ):
            check_range(flag, value, low, high)
        if self.patch_size_px % 2 == 0:
            raise FlagError(f"--{prefix}patch_size_px={self.patch_size_px}: wants an odd number")
