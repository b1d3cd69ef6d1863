"""What to compare and how: options and report of trajectory evaluation."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from maplab_py.options import option
from maplab_py.report import Report

ALIGNMENTS = ("se3", "sim3", "yaw", "none")
DELTA_UNITS = ("frames", "m", "s")


@dataclasses.dataclass(frozen=True)
class TrajectoryEvaluationOptions:
    """How a map's vertices are compared with ground truth."""

    flag_prefix: ClassVar[str] = ""

    alignment: str = option(
        "se3",
        help="Motion that lays the vertices on the ground truth before comparing",
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
    rpe_delta: float = option(1.0, help="Length of the pieces for the relative pose error")
    rpe_delta_unit: str = option(
        "m",
        help="Unit of rpe_delta: frames (vertices), m (travelled), s",
        choices=DELTA_UNITS,
    )
    rpe_all_pairs: bool = option(
        True, help="Pieces from every vertex on; else only consecutive, not overlapping ones"
    )
    align_body_frame: bool = option(
        False,
        help="Remove the constant rotation between the ground truth's body frame and the IMU, "
        "which otherwise adds to the relative errors",
    )


@dataclasses.dataclass(frozen=True)
class ErrorStatistics:
    """Statistics of an error, in the error's unit."""

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float
    count: int


@dataclasses.dataclass(frozen=True)
class MissionEvaluation:
    """One mission, aligned on its own."""

    mission_id: str
    matched: int
    ape_rmse_m: float | None  # None: too few vertices, or all on a line


@dataclasses.dataclass(frozen=True)
class TrajectoryEvaluationReport(Report):
    """Errors of the vertices against ground truth."""

    ground_truth: str
    alignment: str
    vertices: int
    matched: int
    without_ground_truth: int  # outside its span, or in one of its gaps
    ape_m: ErrorStatistics
    ape_deg: ErrorStatistics
    ape_sim3_m: ErrorStatistics | None  # None: the scale cannot be determined
    scale: float | None  # ground truth / map
    body_rotation_deg: float  # constant rotation between ground truth's body frame and the IMU
    rpe_m: ErrorStatistics | None  # None: no piece of the wanted length
    rpe_deg: ErrorStatistics | None
    rpe_pieces: str  # which pieces, in words
    missions: tuple[MissionEvaluation, ...]
