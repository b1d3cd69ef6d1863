"""Options of trajectory evaluation."""

from maplab_py.interop.stamps import time_unit_option
from maplab_py.options import Options, option

ALIGNMENTS = ("se3", "sim3", "yaw", "none")
DELTA_UNITS = ("frames", "m", "s")


class TrajectoryEvaluationOptions(Options):
    """Association, alignment and error metric of the comparison with ground truth."""

    alignment: str = option("se3", choices=ALIGNMENTS)
    """Transformation that aligns the vertices with the ground truth"""
    interpolate: bool = True
    """Interpolate the ground truth at the vertices' times; else take its nearest pose"""
    max_time_difference_s: float = 0.05
    """Largest distance in time between a vertex and the nearest ground-truth pose"""
    time_offset_s: float = 0.0
    """Added to the time stamps of the ground truth"""
    rpe_delta: float = 1.0
    """Length of the segments of the relative pose error"""
    rpe_delta_unit: str = option("m", choices=DELTA_UNITS)
    """Unit of rpe_delta: frames (vertices), m (travelled), s"""
    rpe_all_pairs: bool = True
    """Evaluate a segment from every vertex; else only consecutive segments without overlap"""
    align_body_frame: bool = False
    """Remove the constant rotation between the ground truth's body frame and the IMU, which otherwise adds to
    the relative errors"""
    time_unit: str = time_unit_option()
