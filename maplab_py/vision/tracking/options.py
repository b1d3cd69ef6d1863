"""Options of tracking, with maplab's flag names where it has them."""

import math

from maplab_py.errors import FlagError
from maplab_py.options import option
from maplab_py.vision.features.options import FeatureOptions

_HALF_A_DEGREE = 1.0 - math.cos(math.radians(0.5))


class TrackingOptions(FeatureOptions, prefix="feature_tracking_"):
    """Detection of keypoints, tracking from image to image, and matching between cameras."""

    keypoint_sigma_px: float = option(0.5, ge=1e-3, le=100)
    """Standard deviation of a tracked keypoint"""
    patch_size_px: int = option(15, ge=3, le=101)
    """Side of the patches that are compared"""
    pyramid_levels: int = option(3, ge=0, le=10)
    """Levels of half resolution above the image"""
    forward_backward_px: float = option(0.5, ge=1e-3, le=100)
    """Largest error of a keypoint that is tracked forwards and back again"""
    two_pt_ransac_threshold: float = option(
        _HALF_A_DEGREE, ge=1e-9, le=0.5, flag="feature_tracker_two_pt_ransac_threshold"
    )
    """Two-point RANSAC: largest error of an inlier, as 1 - cos(angle)"""
    two_pt_ransac_max_iterations: int = option(
        200, ge=1, le=100_000, flag="feature_tracker_two_pt_ransac_max_iterations"
    )
    """Two-point RANSAC: largest number of iterations"""
    epipolar_gate_px: float = option(2.0, ge=1e-3, le=1000)
    """Largest distance of a keypoint to its epipolar line after the refinement of turn and direction, and
    between the cameras of a rig"""
    stereo_distance_m: float = option(5.0, ge=1e-2, le=1e6)
    """Distance at which other cameras look for a point of unknown distance"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.patch_size_px % 2 == 0:
            raise FlagError(
                f"--{self.flag_prefix}patch_size_px={self.patch_size_px}: wants an odd number"
            )
