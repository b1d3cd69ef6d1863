"""Reports of the optimisation of a map."""

import dataclasses

from maplab_py.report import Report

_SMALL_DECREASE_PERCENT = 0.1
"""A smaller decrease of the cost over ten iterations changes no pose noticeably."""


@dataclasses.dataclass(frozen=True)
class TermReport:
    """Cost of one kind of measurement."""

    term: str
    count: int
    cost_before: float
    cost_after: float


@dataclasses.dataclass(frozen=True)
class MissionReprojection:
    """Reprojection errors of a mission's observations that are active at the end [px]."""

    mission: str
    observations: int
    mean_before_px: float
    mean_after_px: float
    median_before_px: float
    median_after_px: float


@dataclasses.dataclass(frozen=True)
class CalibratedParameter:
    """An estimated calibration parameter; poses are given as a change."""

    parameter: str
    before: float
    after: float
    sigma: float


class VIOptimizationReport(Report):
    """Result of a batch optimisation.

    Costs before and after are evaluated over the same observations: those active at the end.
    """

    cost_before: float
    cost_after: float
    terms: list[TermReport]
    iterations: int
    rejected_steps: int
    termination: str
    recent_decrease_percent: float  # in the last ten steps, of the cost before them
    vertices: int
    vertices_held: int  # without any constraint
    landmarks: int
    observations: int  # at the beginning
    observations_over_limit: int  # left out by --ba_max_observations_per_landmark
    observations_not_covisible: int  # left out by --ba_max_covisible_frames
    observations_not_used: int  # initial outliers, and landmarks with a single observation
    observations_rejected: int  # as outliers while solving
    mean_reprojection_before_px: float
    mean_reprojection_after_px: float
    median_reprojection_before_px: float
    median_reprojection_after_px: float
    missions: list[MissionReprojection]
    gauge: str
    linear_solver: str  # multifrontal, pcg, 8 submaps, or pcg, then multifrontal
    linear_iterations: int  # of conjugate gradients, in all
    singular_at: list[str]  # states that the measurements do not determine without damping
    calibration: list[CalibratedParameter]
    chi_square_per_freedom: float  # about 1 if all sigmas are correct
    seconds_build: float
    seconds_solve: float
    seconds_total: float
    note: str = ""
    absolute_poses_rejected: int = 0  # outliers that were left out
    trust_region_radius: float = 0.0  # at the end

    @property
    def advice(self) -> str:
        """Return whether more iterations are worth while, or which landmarks are missing."""
        if self.landmarks == 0 and self.observations == 0:
            return "no landmarks were used: init_track_landmarks makes them from feature tracks"
        if self.termination != "iteration limit":
            return ""
        percent = self.recent_decrease_percent
        shown = f"{percent:.0f} %" if percent >= 10.0 else f"{percent:.2g} %"
        steps = min(self.iterations, 10)
        gained = f"iteration limit, the last {steps} iterations lowered the cost by {shown}"
        if self.recent_decrease_percent < _SMALL_DECREASE_PERCENT:
            return f"{gained}: stop here"
        return f"{gained}: run optvi again"
