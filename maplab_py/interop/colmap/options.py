"""Options and reports of the exchange with COLMAP."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

from maplab_py.interop.stamps import time_unit_option
from maplab_py.options import option
from maplab_py.report import Report

QUALITIES = ("good", "not_bad", "all")
TIME_SOURCES = ("name", "file", "order")


@dataclasses.dataclass(frozen=True)
class ColmapExportOptions:
    """Parts of a map to write."""

    quality: str = option("not_bad", help="Landmarks to write, by their quality", choices=QUALITIES)
    colmap_feature_type: str = option(
        "",
        help="Write keypoints of this feature type only, and what they observe: Binary, SIFT, ... or a "
        "number; a database has one kind of descriptors in an image; empty = all keypoints",
    )
    undistort: bool = option(
        False,
        help="Write perspective cameras and undistorted keypoints, as omni cameras need it",
    )
    colmap_format: str = option(
        "binary", help="Format of the model's files", choices=("binary", "text")
    )
    colmap_database: bool = option(
        False, help="Write database.db with keypoints, descriptors and the matches of landmarks"
    )
    colmap_pose_priors: bool = option(
        False, help="Write the positions of the cameras to database.db as priors"
    )


@dataclasses.dataclass(frozen=True)
class ColmapExportReport(Report):
    """Written files."""

    folder: Path
    cameras: int
    rigs: int
    frames: int
    images: int
    points: int
    observations: int
    mean_reprojection_error_px: float
    observations_lost_by_undistortion: int
    files: tuple[Path, ...]


@dataclasses.dataclass(frozen=True)
class ColmapImportOptions:
    """Conversion of a model to a map."""

    timestamps_from: str = option(
        "name",
        help="Source of the images' times: their names, a file, or their order",
        choices=TIME_SOURCES,
    )
    timestamps_file: str = option(
        "", help="File of lines `image name, time stamp` for --timestamps_from=file"
    )
    time_unit: str = time_unit_option()
    order_interval_s: float = option(
        1.0, help="Time between frames for --timestamps_from=order", unit="s"
    )
    scale: float = option(0.0, help="Metres per unit of the model; 0 = unknown", unit="m")
    align_to: str = option(
        "",
        help="Trajectory in metres, with gravity along -z, that the model is aligned with (Sim(3))",
    )
    gravity: str = option(
        "", help="Direction of gravity in the model, x,y,z; `upright` = as the images stand"
    )
    undistort: bool = option(
        False, help="Import cameras that maplab has no model of as perspective cameras"
    )
    colmap_poses: str = option(
        "",
        help="Poses that hold where images differ from rigs and frames; empty = the images, with a note",
        choices=("", "images", "frames"),
    )
    images: str = option("", help="Folder of the images, which become resources; empty = none")
    link_images: bool = option(
        False, help="Refer to the images by symbolic links instead of copying them"
    )
    colmap_keypoint_sigma_px: float = option(
        0.8, help="Standard deviation of the keypoints", unit="px"
    )
    colmap_odometry_sigma_m: float = option(
        0.02, help="Standard deviation of the position of odometry edges", unit="m"
    )
    colmap_odometry_sigma_deg: float = option(
        0.2, help="Standard deviation of the rotation of odometry edges", unit="deg"
    )

    def __post_init__(self) -> None:
        """Check the ranges."""
        for name in (
            "order_interval_s",
            "colmap_keypoint_sigma_px",
            "colmap_odometry_sigma_m",
            "colmap_odometry_sigma_deg",
        ):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} must be greater than 0")


@dataclasses.dataclass(frozen=True)
class ColmapImportReport(Report):
    """Result of an import; the map is marked where scale or gravity are unknown."""

    map_key: str
    missions: tuple[str, ...]
    vertices: int
    frames: int
    landmarks: int
    observations: int
    points_without_observation: int
    images_as_resources: int
    scale: float
    aligned_vertices: int
    alignment_rmse_m: float | None
    notes: tuple[str, ...]
