"""What optvi tells its user."""

from __future__ import annotations

import dataclasses

from maplab_py.report import Report


@dataclasses.dataclass(frozen=True)
class TermReport:
    """One kind of constraint."""

    term: str
    count: int
    cost_before: float
    cost_after: float


@dataclasses.dataclass(frozen=True)
class MissionReprojection:
    """Reprojection errors of one mission's observations that took part to the end [px]."""

    mission: str
    observations: int
    mean_before_px: float
    mean_after_px: float
    median_before_px: float
    median_after_px: float


@dataclasses.dataclass(frozen=True)
class CalibratedParameter:
    """One calibration parameter that was estimated; poses as a change from before."""

    parameter: str
    before: float
    after: float
    sigma: float


@dataclasses.dataclass(frozen=True)
class VIOptimizationReport(Report):
    """Result of a batch optimisation.

    Costs before and after are over the same observations: those that took part to the end.
    """

    cost_before: float
    cost_after: float
    terms: list[TermReport]
    iterations: int
    rejected_steps: int
    termination: str
    vertices: int
    vertices_held: int  # nothing constrains them
    landmarks: int
    observations: int  # at the beginning
    observations_not_used: int  # behind the camera, too far off, or of landmarks seen once
    observations_rejected: int  # as outliers while solving
    mean_reprojection_before_px: float
    mean_reprojection_after_px: float
    median_reprojection_before_px: float
    median_reprojection_after_px: float
    missions: list[MissionReprojection]
    gauge: str
    singular_at: list[str]  # what the measurements did not determine without damping
    calibration: list[CalibratedParameter]
    chi_square_per_freedom: float  # about 1 when all sigmas are right
    seconds_build: float
    seconds_solve: float
    seconds_total: float
