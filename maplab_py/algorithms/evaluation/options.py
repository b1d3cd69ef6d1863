"""Options of trajectory evaluation."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from maplab_py.interop.stamps import time_unit_option
from maplab_py.options import option

ALIGNMENTS = ("se3", "sim3", "yaw", "none")
DELTA_UNITS = ("frames", "m", "s")


@dataclasses.dataclass(frozen=True)
class TrajectoryEvaluationOptions:
    """Association, alignment and error metric of the comparison with ground truth."""

    flag_prefix: ClassVar[str] = ""

    alignment: str = option(
        "se3",
        help="Transformation that aligns the vertices with the ground truth",
        choices=ALIGNMENTS,
    )
    interpolate: bool = option(
        True,
        help="Interpolate the ground truth at the vertices' times; else take its nearest pose",
    )
    max_time_difference_s: float = option(
        0.05,
        help="Largest distance in time between a vertex and the nearest ground-truth pose",
        unit="s",
    )
    time_offset_s: float = option(
        0.0, help="Added to the time stamps of the ground truth", unit="s"
    )
    rpe_delta: float = option(1.0, help="Length of the segments of the relative pose error")
    rpe_delta_unit: str = option(
        "m",
        help="Unit of rpe_delta: frames (vertices), m (travelled), s",
        choices=DELTA_UNITS,
    )
    rpe_all_pairs: bool = option(
        True,
        help="Evaluate a segment from every vertex; else only consecutive segments without overlap",
    )
    align_body_frame: bool = option(
        False,
        help="Remove the constant rotation between the ground truth's body frame and the IMU, "
        "which otherwise adds to the relative errors",
    )
    time_unit: str = time_unit_option()
