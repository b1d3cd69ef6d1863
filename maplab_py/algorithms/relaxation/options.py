"""Options and reports of the relaxation."""

import dataclasses

from maplab_py.options import Options, option
from maplab_py.report import Report


class RelaxationOptions(Options, prefix="relax_"):
    """Flags of pose-graph relaxation.

    The drift rates say how far a mission's own trajectory is trusted between loop closures. They
    describe random walks: the variance grows with distance or time. The defaults are several times
    what a good visual-inertial odometry drifts: too small a rate makes true closures look false,
    too large a one lets false ones deform the trajectory.
    """

    robustness: str = option("gnc", choices=("gnc", "switchable", "dcs", "cauchy", "none"))
    """Treatment of false loop closures: 'gnc' (graduated non-convexity) finds those that
    agree with one another, trusts them fully and the others not at all; 'switchable' estimates a switch
    variable for each one, 'dcs' (dynamic covariance scaling) reduces their weights in closed form, 'cauchy'
    is a Cauchy loss, 'none' trusts all of them."""
    switch_prior: float = 20.0
    """Cost of switching a loop closure off: closures whose squared normalised error (six degrees of freedom)
    is above it lose their weight. With 'gnc' it is multiplied by the variance factor that the closures show,
    so wrong covariances do less harm."""
    position_drift: float = option(0.03, unit="m/sqrt(m)")
    """Position random walk of the trajectories."""
    yaw_drift_deg: float = option(0.4, unit="deg/sqrt(s)")
    """Heading random walk of the trajectories."""
    tilt_drift_deg: float = option(0.1, unit="deg/sqrt(s)")
    """Roll and pitch random walk of the trajectories."""
    tilt_sigma_deg: float = 0.5
    """Uncertainty of roll and pitch: gravity shows them at every vertex."""
    loop_sigma_m: float = 0.05
    """Position uncertainty of loop closures that come without a covariance."""
    loop_sigma_deg: float = 1.0
    """Angular uncertainty of loop closures that come without a covariance."""
    num_iterations: int = 30
    """Iterations of the last optimisation, at most; those before it take a few each."""
    function_tolerance: float = 1e-7
    """Share of the cost that further iterations of the last optimisation may be expected to save when it
    ends."""


@dataclasses.dataclass(frozen=True)
class SwitchedOff:
    """A closure that the relaxed map contradicts."""

    closure: str  # id
    is_edge: bool  # of the map; False = found by this search
    error_m: float  # between what it says and what the relaxed map says
    error_deg: float


class RelaxationReport(Report):
    """Result of a relaxation."""

    num_loop_closures: int = 0  # used as constraints
    num_switched_off: int = 0  # of those, given less than half their weight in the end
    num_ignored: int = 0  # not used at all; `notes` says why
    num_vertices: int = 0  # that could move
    num_base_frames: int = 0  # that moved
    num_clusters: int = 0  # groups of missions held together by closures
    iterations: int = 0
    cost_before: float = 0.0
    cost_after: float = 0.0
    mean_correction_m: float = 0.0
    max_correction_m: float = 0.0
    mean_correction_deg: float = 0.0
    max_correction_deg: float = 0.0
    seconds: float = 0.0
    worst: tuple[SwitchedOff, ...] = ()  # ten at most
    notes: tuple[str, ...] = ()

    @property
    def failure(self) -> str:
        """Return why nothing was relaxed."""
        if self.num_loop_closures > 0:
            return ""
        return "no loop closure edges" + "".join(f"; {note}" for note in self.notes)
