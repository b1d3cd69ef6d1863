"""Options of loop closures between point clouds, and what the search reports."""

import dataclasses

from maplab_py.errors import FlagError
from maplab_py.options import Options, option
from maplab_py.report import Report


class CloudClosureOptions(Options, prefix="lidar_lc_"):
    """Candidates, registration and gates."""

    search_globally: bool = option(False, flag="lidar_lc_global")
    """Compare clouds wherever the map has them, and register them without an initial pose (KISS-Matcher); for
    missions of unknown base frame"""
    from_closures: bool = False
    """Compare only the clouds at the ends of accepted closures that the map records; they give the initial
    poses"""
    max_distance_m: float = 5.0
    """Clouds that are farther apart in the map are not compared"""
    min_time_gap_s: float = 10.0
    """Clouds of one mission that are closer in time are not compared"""
    sequence_gap_s: float = option(1.0, ge=0)
    """Compare each cloud also with those of its mission about this long, and twice as long, before it: they
    limit the drift between places that are visited once; 0 = none"""
    max_candidates: int = option(3, ge=1)
    """Clouds of each mission that a cloud is compared with"""
    every_nth: int = option(1, ge=1)
    """Use every n-th cloud of a sensor only"""
    voxel_size_m: float = option(0.1, gt=0)
    """Clouds are thinned to a point per voxel of this side"""
    max_correspondence_m: float = option(0.3, gt=0)
    """Largest distance of corresponding points at the end of the registration; it starts with eight times
    this"""
    min_overlap: float = option(0.5, ge=0, le=1)
    """Share of the points of either cloud that must lie on surfaces of the other"""
    max_conflict: float = option(0.05, ge=0, le=1)
    """Largest share of points of either cloud in space that the other has seen to be free"""
    max_residual_m: float = 0.04
    """Largest root mean square distance of corresponding points from the surface"""
    min_constraint: float = 0.02
    """Smallest share of points that fix the position along the worst direction: a bare corridor does not fix
    it along its axis"""
    max_gravity_deviation_deg: float = 3.0
    """Largest angle between gravity at the query and in the found pose"""
    max_drift_ratio: float = 0.1
    """Largest drift of a mission relative to the arc length between both clouds; a closure with a larger
    correction (plus 0.5 m) is implausible"""
    min_support: int = 2
    """Number of nearby clouds whose closures must agree in yaw and position"""
    covariance_scaler: float = option(4.0, gt=0)
    """Factor on the inverse Hessian of the registration: errors of neighbouring points are alike"""
    switch_variable_variance: float = option(1e-2, gt=0)
    """Variance of the prior of an edge's switch variable at 1"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.search_globally and self.from_closures:
            raise FlagError("--lidar_lc_global and --lidar_lc_from_closures exclude each other")


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
        """Return how the edges take effect."""
        if self.edges_added:
            return "relax, or optvi --ba_include_loop_closure_edges, uses the edges"
        return "" if not self.pairs else "lc_report --which=refused shows all candidates"
