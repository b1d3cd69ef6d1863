"""Options of keypoints, with maplab's flag names where it has them."""

from maplab_py.options import Options, option

DETECTORS = ("fast", "agast")
DESCRIPTORS = ("brisk", "xfeat")
NETWORKS = ("xfeat",)
"""Descriptors by networks, which are installed and slow."""


class FeatureOptions(Options, prefix="feature_tracking_"):
    """Preparation of images, and detection and description of keypoints."""

    detector_type: str = option("fast", choices=DETECTORS)
    """Corner test: fast and agast decide alike, fast is faster in this OpenCV"""
    detector_threshold: int = option(20, ge=1, le=255)
    """Smallest contrast of a corner; where a cell has too few corners, a third of it suffices"""
    detector_max_feature_count: int = option(250, ge=1, le=10_000)
    """Largest number of keypoints of an image"""
    detector_nms_radius: float = option(14.0, ge=0, le=1000, unit="px")
    """Smallest distance between a new keypoint and stronger or tracked ones"""
    gridded_detector_num_grid_cols: int = option(4, ge=1, le=100)
    """Columns of the detection grid"""
    gridded_detector_num_grid_rows: int = option(2, ge=1, le=100)
    """Rows of the detection grid"""
    gridded_detector_cell_num_features_scaler: float = option(2.0, ge=1, le=10_000)
    """Largest number of keypoints of a cell, as a multiple of its equal share of all"""
    min_tracking_distance_to_image_border_px: int = option(
        20, ge=4, le=1000, flag="min_tracking_distance_to_image_border_px"
    )
    """Smallest distance of a keypoint to the image border; descriptors need 20"""
    descriptor_type: str = option("brisk", choices=DESCRIPTORS)
    """Descriptor of tracked keypoints: brisk (Binary, 64 bytes), or xfeat (XFeat, 64 numbers, a network:
    install_features), which other light and other directions change less"""
    descriptor_size_px: float = option(12.0, ge=1, le=1000)
    """Diameter of what a descriptor sees, OpenCV's keypoint size"""
    apply_clahe: bool = option(False, flag="rovioli_image_apply_clahe_histogram_equalization")
    """Equalise the contrast of images locally (CLAHE)"""
    clahe_clip_limit: int = option(2, ge=1, le=100, flag="rovioli_image_clahe_clip_limit")
    """CLAHE: limit of contrast"""
    clahe_grid_size: int = option(8, ge=1, le=100, flag="rovioli_image_clahe_grid_size")
    """CLAHE: rows and columns of tiles"""
    image_resize_factor: float = option(1.0, ge=0.05, le=4, flag="rovioli_image_resize_factor")
    """Track in images resized by this factor; keypoints are of the recorded size"""
    image_mask_path: str = option("", flag="rovio_image_mask_path")
    """Image in which black areas are not to be used, or several, by camera, separated by commas"""
