"""Options of keypoints, with maplab's flag names where it has them."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from maplab_py.errors import FlagError
from maplab_py.options import option

DETECTORS = ("fast", "agast")
DESCRIPTORS = ("brisk",)


@dataclasses.dataclass(frozen=True)
class FeatureOptions:
    """Preparation of images, and detection and description of keypoints."""

    flag_prefix: ClassVar[str] = "feature_tracking_"

    detector_type: str = option(
        "fast",
        help="Corner test: fast and agast decide alike, fast is faster in this OpenCV",
        choices=DETECTORS,
    )
    detector_threshold: int = option(
        20,
        help="Smallest contrast of a corner; where a cell has too few corners, a third of it suffices",
    )
    detector_max_feature_count: int = option(250, help="Largest number of keypoints of an image")
    detector_nms_radius: float = option(
        14.0,
        help="Smallest distance between a new keypoint and stronger or tracked ones",
        unit="px",
    )
    gridded_detector_num_grid_cols: int = option(4, help="Columns of the detection grid")
    gridded_detector_num_grid_rows: int = option(2, help="Rows of the detection grid")
    gridded_detector_cell_num_features_scaler: float = option(
        2.0, help="Largest number of keypoints of a cell, as a multiple of its equal share of all"
    )
    min_tracking_distance_to_image_border_px: int = option(
        20,
        help="Smallest distance of a keypoint to the image border; descriptors need 20",
        unit="px",
        flag="min_tracking_distance_to_image_border_px",
    )
    descriptor_type: str = option("brisk", help="Descriptor: brisk (of 64 bytes)")
    descriptor_size_px: float = option(
        12.0, help="Diameter of what a descriptor sees, OpenCV's keypoint size", unit="px"
    )
    apply_clahe: bool = option(
        False,
        help="Equalise the contrast of images locally (CLAHE)",
        flag="rovioli_image_apply_clahe_histogram_equalization",
    )
    clahe_clip_limit: int = option(
        2, help="CLAHE: limit of contrast", flag="rovioli_image_clahe_clip_limit"
    )
    clahe_grid_size: int = option(
        8, help="CLAHE: rows and columns of tiles", flag="rovioli_image_clahe_grid_size"
    )
    image_resize_factor: float = option(
        1.0,
        help="Track in images resized by this factor; keypoints are of the recorded size",
        flag="rovioli_image_resize_factor",
    )
    image_mask_path: str = option(
        "",
        help="Image in which black areas are not to be used, or several, by camera, separated by "
        "commas",
        flag="rovio_image_mask_path",
    )

    def check(self) -> None:
        """Check the values.

        Raises:
            FlagError: A value is out of its range, or the descriptor is not available.
        """
        self._check_descriptor()
        prefix = self.flag_prefix
        for flag, value, low, high in (
            ("detector_threshold", self.detector_threshold, 1, 255),
            ("detector_max_feature_count", self.detector_max_feature_count, 1, 10_000),
            ("detector_nms_radius", self.detector_nms_radius, 0, 1000),
            ("gridded_detector_num_grid_cols", self.gridded_detector_num_grid_cols, 1, 100),
            ("gridded_detector_num_grid_rows", self.gridded_detector_num_grid_rows, 1, 100),
            (
                "gridded_detector_cell_num_features_scaler",
                self.gridded_detector_cell_num_features_scaler,
                1,
                10_000,
            ),
            ("descriptor_size_px", self.descriptor_size_px, 1, 1000),
        ):
            check_range(prefix + flag, value, low, high)
        border = self.min_tracking_distance_to_image_border_px
        check_range("min_tracking_distance_to_image_border_px", border, 4, 1000)
        check_range("rovioli_image_clahe_clip_limit", self.clahe_clip_limit, 1, 100)
        check_range("rovioli_image_clahe_grid_size", self.clahe_grid_size, 1, 100)
        check_range("rovioli_image_resize_factor", self.image_resize_factor, 0.05, 4)

    def _check_descriptor(self) -> None:
        if self.detector_type not in DETECTORS:
            raise FlagError(
                f"--{self.flag_prefix}detector_type={self.detector_type}: wants one of "
                + ", ".join(DETECTORS)
            )
        if self.descriptor_type == "freak":
            raise FlagError(
                f"--{self.flag_prefix}descriptor_type=freak: FREAK is not in the OpenCV that this "
                "package uses: choose brisk"
            )
        if self.descriptor_type not in DESCRIPTORS:
            raise FlagError(
                f"--{self.flag_prefix}descriptor_type={self.descriptor_type}: wants brisk"
            )


def check_range(flag: str, value: float, low: float, high: float) -> None:
    """Check that the value of a flag lies between two numbers.

    Raises:
        FlagError: It does not.
    """
    if not low <= value <= high:
        raise FlagError(f"--{flag}={value:g}: wants a number from {low:g} to {high:g}")
