"""Options and reports of the exchange with COLMAP."""

from pathlib import Path

from maplab_py.interop.stamps import time_unit_option
from maplab_py.options import Options, option
from maplab_py.report import Report


class ColmapExportOptions(Options):
    """Parts of a map to write."""

    quality: str = option("not_bad", choices=("good", "not_bad", "all"))
    """Landmarks to write, by their quality"""
    colmap_feature_type: str = ""
    """Write keypoints of this feature type only, and what they observe: Binary, SIFT, ... or a number; a
    database has one kind of descriptors in an image; empty = all keypoints"""
    undistort: bool = False
    """Write perspective cameras and undistorted keypoints, as omni cameras need it"""
    colmap_format: str = option("binary", choices=("binary", "text"))
    """Format of the model's files"""
    colmap_database: bool = False
    """Write database.db with keypoints, descriptors and the matches of landmarks"""
    colmap_pose_priors: bool = False
    """Write the positions of the cameras to database.db as priors"""


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


class ColmapImportOptions(Options):
    """Conversion of a model to a map."""

    timestamps_from: str = option("name", choices=("name", "file", "order"))
    """Source of the images' times: their names, a file, or their order"""
    timestamps_file: str = ""
    """File of lines `image name, time stamp` for --timestamps_from=file"""
    time_unit: str = time_unit_option()
    order_interval_s: float = option(1.0, gt=0)
    """Time between frames for --timestamps_from=order"""
    scale: float = option(0.0, unit="m")
    """Metres per unit of the model; 0 = unknown"""
    align_to: str = ""
    """Trajectory in metres, with gravity along -z, that the model is aligned with (Sim(3))"""
    gravity: str = ""
    """Direction of gravity in the model, x,y,z; `upright` = as the images stand"""
    undistort: bool = False
    """Import cameras that maplab has no model of as perspective cameras"""
    colmap_poses: str = option("", choices=("", "images", "frames"))
    """Poses that hold where images differ from rigs and frames; empty = the images, with a note"""
    images: str = ""
    """Folder of the images, which become resources; empty = none"""
    link_images: bool = False
    """Refer to the images by symbolic links instead of copying them"""
    colmap_keypoint_sigma_px: float = option(0.8, gt=0)
    """Standard deviation of the keypoints"""
    colmap_odometry_sigma_m: float = option(0.02, gt=0)
    """Standard deviation of the position of odometry edges"""
    colmap_odometry_sigma_deg: float = option(0.2, gt=0)
    """Standard deviation of the rotation of odometry edges"""


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
