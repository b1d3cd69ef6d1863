"""Options of loop closures between point clouds, and what the search reports."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from maplab_py.options import option
from maplab_py.report import Report


@dataclasses.dataclass(frozen=True)
class CloudClosureOptions:
    """Candidates, registration and gates."""

    flag_prefix: ClassVar[str] = "lidar_lc_"

    search_globally: bool = option(
        False,
        help="Compare clouds wherever the map has them, and register them without an initial pose "
        "(KISS-Matcher); for missions of unknown base frame",
        flag="lidar_lc_global",
    )
    from_closures: bool = option(
        False,
        help="Compare only the clouds at the ends of accepted closures that the map records; they give "
        "the initial poses",
    )
    max_distance_m: float = option(
        5.0, help="Clouds that are farther apart in the map are not compared", unit="m"
    )
    min_time_gap_s: float = option(
        10.0, help="Clouds of one mission that are closer in time are not compared", unit="s"
    )
    sequence_gap_s: float = option(
        1.0,
        help="Compare each cloud also with those of its mission about this long, and twice as long, before "
        "it: they limit the drift between places that are visited once; 0 = none",
        unit="s",
    )
    max_candidates: int = option(3, help="Clouds of each mission that a cloud is compared with")
    every_nth: int = option(1, help="Use every n-th cloud of a sensor only")
    voxel_size_m: float = option(
        0.1, help="Clouds are thinned to a point per voxel of this side", unit="m"
    )
    max_correspondence_m: float = option(
        0.3,
        help="Largest distance of corresponding points at the end of the registration; it starts with "
        "eight times this",
        unit="m",
    )
    min_overlap: float = option(
        0.5, help="Share of the points of either cloud that must lie on surfaces of the other"
    )
    max_conflict: float = option(
        0.05,
        help="Largest share of points of either cloud in space that the other has seen to be free",
    )
    max_residual_m: float = option(
        0.04,
        help="Largest root mean square distance of corresponding points from the surface",
        unit="m",
    )
    min_constraint: float = option(
        0.02,
        help="Smallest share of points that fix the position along the worst direction: a bare corridor "
        "does not fix it along its axis",
    )
    max_gravity_deviation_deg: float = option(
        3.0, help="Largest angle between gravity at the query and in the found pose", unit="deg"
    )
    max_drift_ratio: float = option(
        0.1,
        help="Largest drift of a mission relative to the arc length between both clouds; a closure with a "
        "larger correction (plus 0.5 m) is implausible",
    )
    min_support: int = option(
        2, help="Number of nearby clouds whose closures must agree in yaw and position"
    )
    covariance_scaler: float = option(
        4.0,
        help="Factor on the inverse Hessian of the registration: errors of neighbouring points are alike",
    )
    switch_variable_variance: float = option(
        1e-2, help="Variance of the prior of an edge's switch variable at 1"
    )

    def __post_init__(self) -> None:
        """Check the ranges."""
        if self.voxel_size_m <= 0.0 or self.max_correspondence_m <= 0.0:
            raise ValueError(
                "--lidar_lc_voxel_size_m and --lidar_lc_max_correspondence_m must be positive"
            )
        if self.max_candidates < 1 or self.every_nth < 1:
            raise ValueError(
                "--lidar_lc_max_candidates and --lidar_lc_every_nth must be 1 or greater"
            )
        if self.sequence_gap_s < 0.0:
            raise ValueError("--lidar_lc_sequence_gap_s must be 0 or greater")
        if not 0.0 <= self.min_overlap <= 1.0 or not 0.0 <= self.max_conflict <= 1.0:
            raise ValueError(
                "--lidar_lc_min_overlap and --lidar_lc_max_conflict must be between 0 and 1"
            )
        if self.covariance_scaler <= 0.0 or self.switch_variable_variance <= 0.0:
            raise ValueError(
                "--lidar_lc_covariance_scaler and --lidar_lc_switch_variable_variance must be positive"
            )
        if self.search_globally and self.from_closures:
            raise ValueError("--lidar_lc_global and --lidar_lc_from_closures exclude each other")


@dataclasses.dataclass(frozen=True)
class CloudClosureReport(Report):
    """Counts of a search for loop closures between clouds."""

    clouds: int = 0
    pairs: int = 0  # registered
    accepted: int = 0
    edges_added: int = 0
    refused: dict[str, int] = dataclasses.field(default_factory=dict)  # by reason
    missions_joined: tuple[str, ...] = ()  # "short id - short id: closures"
    median_overlap: float = 0.0  # of accepted closures
    median_residual_m: float = 0.0
    median_correction_m: float = 0.0
    largest_correction_m: float = 0.0
    notes: tuple[str, ...] = ()
    reason: str = ""  # why there is no edge, empty when there is one

    @property
    def failure(self) -> str:
        """Return why no edge was added."""
        return self.reason

    @property
    def advice(self) -> str:
        """Tell how the edges take effect."""
        if self.edges_added:
            return "relax, or optvi --ba_include_loop_closure_edges, uses the edges"
        return "" if not self.pairs else "lc_report --which=refused shows all candidates"
