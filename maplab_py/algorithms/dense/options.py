"""Options of dense reconstruction; names are those of maplab where it has them."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import ClassVar

from maplab_py.options import option

MESH_MIN_WEIGHT = 2.5
"""Weight from which a voxel counts as observed, in measurements at a depth of 2 m."""


@dataclasses.dataclass(frozen=True)
class FusionOptions:
    """Grid of truncated signed distances, and the weights of measurements."""

    flag_prefix: ClassVar[str] = "dense_tsdf_"

    voxel_size_m: float = option(0.10, help="Side of a voxel", unit="m")
    truncation_distance_m: float = option(
        0.0, help="Distances are limited to this; 0 = three voxels", unit="m"
    )
    min_ray_length_m: float = option(0.2, help="Smallest depth that is used", unit="m")
    max_ray_length_m: float = option(6.0, help="Largest depth that is used", unit="m")
    weight_depth_power: int = option(
        4,
        help="The weight of a measurement falls with this power of its depth: 4 for stereo, whose "
        "variance grows with it, 2 or 0 for depth sensors",
    )
    max_weight: float = option(10000.0, help="Largest weight of a voxel")
    integrate_every_nth: int = option(1, help="Integrate every n-th depth map only")

    def __post_init__(self) -> None:
        """Check the ranges."""
        if self.voxel_size_m <= 0.0 or self.truncation_distance_m < 0.0:
            raise ValueError(
                "--dense_tsdf_voxel_size_m must be positive, --dense_tsdf_truncation_distance_m 0 or "
                "greater"
            )
        if not 0.0 < self.min_ray_length_m < self.max_ray_length_m:
            raise ValueError(
                "0 < --dense_tsdf_min_ray_length_m < --dense_tsdf_max_ray_length_m must hold"
            )
        if not 0 <= self.weight_depth_power <= 8 or self.integrate_every_nth < 1:
            raise ValueError(
                "--dense_tsdf_weight_depth_power must be 0 to 8, --dense_tsdf_integrate_every_nth 1 or "
                "greater"
            )
        if self.max_weight <= 0.0:
            raise ValueError("--dense_tsdf_max_weight must be positive")

    @property
    def truncation_m(self) -> float:
        """The truncation distance [m]."""
        return self.truncation_distance_m or 3.0 * self.voxel_size_m


@dataclasses.dataclass(frozen=True)
class DistanceOptions:
    """Reach of distances, and free space near the robot."""

    flag_prefix: ClassVar[str] = "dense_esdf_"

    max_distance_m: float = option(2.0, help="Distances are limited to this", unit="m")
    use_clear_sphere: bool = option(
        False,
        help="Around every camera, count voxels that no depth map has observed as free inside the inner "
        "radius, and as occupied between it and the outer radius",
    )
    clear_sphere_inner_radius: float = option(0.3, help="Inner radius", unit="m")
    clear_sphere_outer_radius: float = option(1.0, help="Outer radius", unit="m")
    export_map_for_panning_path: Path | None = option(
        None,
        help="Also write the voxels for a path planner: a .ply cloud of their centres in the global frame "
        "with the distance as intensity",
    )

    def __post_init__(self) -> None:
        """Check the ranges."""
        if not 0.0 < self.max_distance_m < float("inf"):
            raise ValueError("--dense_esdf_max_distance_m must be positive")
        if not 0.0 <= self.clear_sphere_inner_radius <= self.clear_sphere_outer_radius:
            raise ValueError(
                "0 <= --dense_esdf_clear_sphere_inner_radius <= --dense_esdf_clear_sphere_outer_radius "
                "must hold"
            )


_SGBM_MODES = 4


@dataclasses.dataclass(frozen=True)
class SgbmOptions:
    """Semi-global block matching: Hirschmueller, PAMI 2008; OpenCV's StereoSGBM."""

    flag_prefix: ClassVar[str] = "dense_stereo_sgbm_"

    mode: int = option(0, help="0 = SGBM, 1 = HH, 2 = SGBM_3WAY, 3 = HH4")
    min_disparity: int = option(0, help="Smallest disparity", unit="px")
    num_disparities: int = option(128, help="Number of disparities, a multiple of 16", unit="px")
    sad_window_size: int = option(3, help="Side of the blocks that are compared, odd", unit="px")
    p1: int = option(72, help="Penalty for a disparity that changes by one pixel")
    p2: int = option(288, help="Penalty for a disparity that changes by more")
    disp12_max_diff: int = option(1, help="Tolerance of the left-right check", unit="px")
    pre_filter_cap: int = option(31, help="Bound of the gradients that are compared")
    uniqueness_ratio: int = option(10, help="Margin to the second best disparity, in percent")
    speckle_window_size: int = option(500, help="Smaller regions are removed; in pixels of area")
    speckle_range: int = option(3, help="Difference of disparities inside a region", unit="px")


@dataclasses.dataclass(frozen=True)
class BmOptions:
    """Block matching: Konolige, ISRR 1997; OpenCV's StereoBM."""

    flag_prefix: ClassVar[str] = "dense_stereo_bm_"

    min_disparity: int = option(0, help="Smallest disparity", unit="px")
    num_disparities: int = option(128, help="Number of disparities, a multiple of 16", unit="px")
    sad_window_size: int = option(9, help="Side of the blocks that are compared, odd", unit="px")
    disp12_max_diff: int = option(1, help="Tolerance of the left-right check", unit="px")
    pre_filter_cap: int = option(31, help="Bound of the filtered values")
    pre_filter_size: int = option(9, help="Side of the filter's window, odd", unit="px")
    prefilter_type: str = option(
        "xsobel", help="Filter of the images", choices=("xsobel", "normalized_response")
    )
    texture_threshold: int = option(10, help="Blocks with less texture have no disparity")
    uniqueness_ratio: int = option(15, help="Margin to the second best disparity, in percent")
    speckle_window_size: int = option(500, help="Smaller regions are removed; in pixels of area")
    speckle_range: int = option(3, help="Difference of disparities inside a region", unit="px")


@dataclasses.dataclass(frozen=True)
class StereoOptions:
    """Choice of stereo pairs, preparation of images, and checks."""

    flag_prefix: ClassVar[str] = "dense_stereo_"

    use_sgbm: bool = option(True, help="Semi-global block matching; else plain block matching")
    downscaling_factor: float = option(
        1.0, help="Images are matched at this fraction of their size"
    )
    adapt_params_to_image_size: bool = option(
        True, help="Take an eighth of the image's width as the number of disparities"
    )
    min_baseline: float = option(
        0.02, help="Pairs of cameras nearer to each other are left out", unit="m"
    )
    max_angle_between_opt_axes: float = option(
        0.785, help="Pairs whose optical axes differ by more are left out", unit="rad"
    )
    depth_check: bool = option(
        True, help="Remove what the right image does not confirm", flag="dense_depth_check"
    )
    median_window: int = option(
        5, help="Side of the median filter of disparities, 0 (none), 3 or 5", unit="px"
    )
    bilateral_window: int = option(
        15,
        help="Side of the bilateral filter of disparities, which keeps edges; 0 = none",
        unit="px",
    )
    edge_margin: int = option(
        3,
        help="Pixels so near to a step of the depth are removed: they belong to either side",
        unit="px",
    )
    multi_view: bool = option(True, help="Remove what neighbouring vertices do not confirm")
    multi_view_min_agreeing: int = option(2, help="Neighbouring vertices that must confirm a pixel")
    multi_view_max_difference: float = option(
        1.0, help="Difference of disparities that counts as confirmation", unit="px"
    )
    multi_view_interval_s: float = option(
        0.2,
        help="Time between the neighbours that are asked, three before and three after",
        unit="s",
    )

    debug_reconstruction_start_fraction_of_trajectory: float = option(
        0.0, help="Part of each mission's vertices before the first that is used"
    )
    debug_reconstruction_end_fraction_of_trajectory: float = option(
        1.0, help="Part of each mission's vertices up to the last that is used"
    )

    def __post_init__(self) -> None:
        """Check the ranges."""
        start = self.debug_reconstruction_start_fraction_of_trajectory
        if not 0.0 <= start < self.debug_reconstruction_end_fraction_of_trajectory <= 1.0:
            raise ValueError(
                "0 <= --dense_stereo_debug_reconstruction_start_fraction_of_trajectory < "
                "--dense_stereo_debug_reconstruction_end_fraction_of_trajectory <= 1 must hold"
            )
        if not 0.0 < self.downscaling_factor <= 1.0:
            raise ValueError("--dense_stereo_downscaling_factor must be in (0, 1]")
        if self.median_window not in (0, 3, 5) or self.edge_margin < 0:
            raise ValueError(
                "--dense_stereo_median_window must be 0, 3 or 5, --dense_stereo_edge_margin 0 or greater"
            )
        if not 0 <= self.bilateral_window <= 31:
            raise ValueError("--dense_stereo_bilateral_window must be 0 to 31")
        if self.min_baseline <= 0.0:
            raise ValueError("--dense_stereo_min_baseline must be positive")
        if self.multi_view_min_agreeing < 1:
            raise ValueError("--dense_stereo_multi_view_min_agreeing must be 1 or greater")
        if self.multi_view_interval_s < 0.0 or self.multi_view_max_difference <= 0.0:
            raise ValueError(
                "--dense_stereo_multi_view_interval_s must be 0 or greater, "
                "--dense_stereo_multi_view_max_difference positive"
            )


def check_matcher(options: SgbmOptions | BmOptions) -> None:
    """Check the ranges that OpenCV would refuse with its own message.

    Raises:
        ValueError: A value is out of range.
    """
    name = options.flag_prefix
    if options.num_disparities < 16 or options.num_disparities % 16:
        raise ValueError(f"--{name}num_disparities must be a positive multiple of 16")
    smallest = 1 if isinstance(options, SgbmOptions) else 5
    if options.sad_window_size < smallest or options.sad_window_size % 2 == 0:
        raise ValueError(f"--{name}sad_window_size must be odd and at least {smallest}")
    if isinstance(options, SgbmOptions):
        if not 0 <= options.mode < _SGBM_MODES or not 0 < options.p1 < options.p2:
            raise ValueError(f"--{name}mode must be 0 to 3, and 0 < --{name}p1 < --{name}p2")
    elif options.pre_filter_size % 2 == 0 or not 5 <= options.pre_filter_size <= 255:
        raise ValueError(f"--{name}pre_filter_size must be odd, 5 to 255")
    elif not 1 <= options.pre_filter_cap <= 63:
        raise ValueError(f"--{name}pre_filter_cap must be 1 to 63")
