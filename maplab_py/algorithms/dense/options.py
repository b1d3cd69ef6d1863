"""Options of dense reconstruction; names are those of maplab where it has them."""

from pathlib import Path

from maplab_py.errors import FlagError
from maplab_py.options import Options, option

MESH_MIN_WEIGHT = 2.5
"""Weight from which a voxel counts as observed, in measurements at a depth of 2 m."""


class FusionOptions(Options, prefix="dense_tsdf_"):
    """Grid of truncated signed distances, and the weights of measurements."""

    voxel_size_m: float = option(0.0, ge=0)
    """Side of a voxel; 0 = a fortieth of the scene's median depth, from 1 cm to 10 cm"""
    truncation_distance_m: float = option(0.0, ge=0)
    """Distances are limited to this; 0 = three voxels"""
    min_ray_length_m: float = option(0.2, gt=0)
    """Smallest depth that is used"""
    max_ray_length_m: float = 6.0
    """Largest depth that is used"""
    weight_depth_power: int = option(4, ge=0, le=8)
    """The weight of a measurement falls with this power of its depth: 4 for stereo, whose variance grows with
    it, 2 or 0 for depth sensors"""
    max_weight: float = option(10000.0, gt=0)
    """Largest weight of a voxel"""
    integrate_every_nth: int = option(1, ge=1)
    """Integrate every n-th depth map only"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.min_ray_length_m < self.max_ray_length_m < float("inf"):
            raise FlagError(
                "--dense_tsdf_min_ray_length_m must be below --dense_tsdf_max_ray_length_m"
            )


class DistanceOptions(Options, prefix="dense_esdf_"):
    """Reach of distances, and free space near the robot."""

    max_distance_m: float = option(2.0, gt=0)
    """Distances are limited to this"""
    use_clear_sphere: bool = False
    """Around every camera, count voxels that no depth map has observed as free inside the inner radius, and
    as occupied between it and the outer radius"""
    clear_sphere_inner_radius: float = option(0.3, ge=0, unit="m")
    """Inner radius"""
    clear_sphere_outer_radius: float = option(1.0, unit="m")
    """Outer radius"""
    export_map_for_panning_path: Path | None = None
    """Also write the voxels for a path planner: a .ply cloud of their centres in the global frame with the
    distance as intensity"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.clear_sphere_inner_radius <= self.clear_sphere_outer_radius:
            raise FlagError(
                "--dense_esdf_clear_sphere_inner_radius must not exceed "
                "--dense_esdf_clear_sphere_outer_radius"
            )


_SGBM_MODES = 4


class SgbmOptions(Options, prefix="dense_stereo_sgbm_"):
    """Semi-global block matching: Hirschmueller, PAMI 2008; OpenCV's StereoSGBM."""

    mode: int = 0
    """0 = SGBM, 1 = HH, 2 = SGBM_3WAY, 3 = HH4"""
    min_disparity: int = option(0, unit="px")
    """Smallest disparity"""
    num_disparities: int = option(128, unit="px")
    """Number of disparities, a multiple of 16"""
    sad_window_size: int = option(3, unit="px")
    """Side of the blocks that are compared, odd"""
    p1: int = 72
    """Penalty for a disparity that changes by one pixel"""
    p2: int = 288
    """Penalty for a disparity that changes by more"""
    disp12_max_diff: int = option(1, unit="px")
    """Tolerance of the left-right check"""
    pre_filter_cap: int = 31
    """Bound of the gradients that are compared"""
    uniqueness_ratio: int = 10
    """Margin to the second best disparity, in percent"""
    speckle_window_size: int = 500
    """Smaller regions are removed; in pixels of area"""
    speckle_range: int = option(3, unit="px")
    """Difference of disparities inside a region"""


class BmOptions(Options, prefix="dense_stereo_bm_"):
    """Block matching: Konolige, ISRR 1997; OpenCV's StereoBM."""

    min_disparity: int = option(0, unit="px")
    """Smallest disparity"""
    num_disparities: int = option(128, unit="px")
    """Number of disparities, a multiple of 16"""
    sad_window_size: int = option(9, unit="px")
    """Side of the blocks that are compared, odd"""
    disp12_max_diff: int = option(1, unit="px")
    """Tolerance of the left-right check"""
    pre_filter_cap: int = 31
    """Bound of the filtered values"""
    pre_filter_size: int = option(9, unit="px")
    """Side of the filter's window, odd"""
    prefilter_type: str = option("xsobel", choices=("xsobel", "normalized_response"))
    """Filter of the images"""
    texture_threshold: int = 10
    """Blocks with less texture have no disparity"""
    uniqueness_ratio: int = 15
    """Margin to the second best disparity, in percent"""
    speckle_window_size: int = 500
    """Smaller regions are removed; in pixels of area"""
    speckle_range: int = option(3, unit="px")
    """Difference of disparities inside a region"""


class StereoOptions(Options, prefix="dense_stereo_"):
    """Choice of stereo pairs, preparation of images, and checks."""

    use_sgbm: bool = True
    """Semi-global block matching; else plain block matching"""
    downscaling_factor: float = option(1.0, gt=0, le=1)
    """Images are matched at this fraction of their size"""
    adapt_params_to_image_size: bool = True
    """Take an eighth of the image's width as the number of disparities, more where landmarks are nearer"""
    min_baseline: float = option(0.02, gt=0, unit="m")
    """Pairs of cameras nearer to each other are left out"""
    max_angle_between_opt_axes: float = option(0.785, unit="rad")
    """Pairs whose optical axes differ by more are left out"""
    depth_check: bool = option(True, flag="dense_depth_check")
    """Remove what the right image does not confirm"""
    median_window: int = option(5, unit="px")
    """Side of the median filter of disparities, 0 (none), 3 or 5"""
    bilateral_window: int = option(15, ge=0, le=31, unit="px")
    """Side of the bilateral filter of disparities, which keeps edges; 0 = none"""
    edge_margin: int = option(3, ge=0, unit="px")
    """Pixels so near to a step of the depth are removed: they belong to either side"""
    multi_view: bool = True
    """Remove what neighbouring vertices do not confirm"""
    multi_view_min_agreeing: int = option(2, ge=1)
    """Neighbouring vertices that must confirm a pixel"""
    multi_view_max_difference: float = option(1.0, gt=0, unit="px")
    """Difference of disparities that counts as confirmation"""
    multi_view_interval_s: float = option(0.2, ge=0)
    """Time between the neighbours that are asked, three before and three after"""

    debug_reconstruction_start_fraction_of_trajectory: float = option(0.0, ge=0)
    """Part of each mission's vertices before the first that is used"""
    debug_reconstruction_end_fraction_of_trajectory: float = option(1.0, le=1)
    """Part of each mission's vertices up to the last that is used"""

    def __post_init__(self) -> None:
        super().__post_init__()
        start = self.debug_reconstruction_start_fraction_of_trajectory
        if not start < self.debug_reconstruction_end_fraction_of_trajectory:
            raise FlagError(
                "--dense_stereo_debug_reconstruction_start_fraction_of_trajectory must be below "
                "--dense_stereo_debug_reconstruction_end_fraction_of_trajectory"
            )
        if self.median_window not in (0, 3, 5):
            raise FlagError("--dense_stereo_median_window must be 0, 3 or 5")


def check_matcher(options: SgbmOptions | BmOptions) -> None:
    """Check the ranges that OpenCV would refuse with its own message.

    Raises:
        FlagError: A value is out of range.
    """
    name = options.flag_prefix
    if options.num_disparities < 16 or options.num_disparities % 16:
        raise FlagError(f"--{name}num_disparities must be a positive multiple of 16")
    smallest = 1 if isinstance(options, SgbmOptions) else 5
    if options.sad_window_size < smallest or options.sad_window_size % 2 == 0:
        raise FlagError(f"--{name}sad_window_size must be odd and at least {smallest}")
    if isinstance(options, SgbmOptions):
        if not 0 <= options.mode < _SGBM_MODES or not 0 < options.p1 < options.p2:
            raise FlagError(f"--{name}mode must be 0 to 3, and 0 < --{name}p1 < --{name}p2")
    elif options.pre_filter_size % 2 == 0 or not 5 <= options.pre_filter_size <= 255:
        raise FlagError(f"--{name}pre_filter_size must be odd, 5 to 255")
    elif not 1 <= options.pre_filter_cap <= 63:
        raise FlagError(f"--{name}pre_filter_cap must be 1 to 63")
