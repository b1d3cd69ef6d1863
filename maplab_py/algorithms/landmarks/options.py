"""Options of the landmark algorithms; maplab's names and defaults."""

from maplab_py.errors import FlagError
from maplab_py.options import Options, option
from maplab_py.report import Report


class LandmarkQualityOptions(Options, prefix="elq_"):
    """Criteria for well-constrained landmarks."""

    min_observers: int = option(2, ge=0)
    """Smallest number of vertices that observe a landmark."""
    min_observation_angle_deg: float = option(2.0, ge=0, le=180)
    """Smallest angle between the two most different rays."""
    max_relative_sigma: float = 0.05
    """Largest standard deviation of a landmark along its worst axis, relative to its distance from the
    closest observer; predicted from its rays and reprojection errors; negative = not checked."""
    min_distance_from_closest_observer: float = option(0.05, unit="m")
    """Smallest distance of a landmark from its closest observer."""
    max_distance_from_closest_observer: float = option(40.0, unit="m")
    """Largest distance of a landmark from its closest observer."""
    max_reprojection_error_px: float = -1.0
    """Largest reprojection error of any observation; negative = not checked."""
    lidar_min_observers: int = option(1, ge=0)
    """Smallest number of vertices that observe a lidar landmark."""
    lidar_min_distance_from_closest_observer: float = option(1.0, unit="m")
    """Smallest distance of a lidar landmark from its closest observer."""
    lidar_max_distance_from_closest_observer: float = option(60.0, unit="m")
    """Largest distance of a lidar landmark from its closest observer."""
    lidar_max_observation_error_m: float = -1.0
    """Largest distance of any lidar observation from its landmark; negative = not checked."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for prefix in ("", "lidar_"):
            low = getattr(self, f"{prefix}min_distance_from_closest_observer")
            high = getattr(self, f"{prefix}max_distance_from_closest_observer")
            if low > high:
                raise FlagError(
                    f"--elq_{prefix}min_distance_from_closest_observer is larger than the maximum"
                )


class InvalidObservationOptions(Options, prefix="rio_"):
    """Criteria for invalid observations."""

    max_reprojection_error_px: float = option(50.0, gt=0)
    """Largest reprojection error of a valid observation."""
    make_new_landmarks: bool = True
    """Make new landmarks from detached observations of one feature track."""


_MANY_BAD = 0.8
"""Share of bad landmarks from which on the criteria are doubtful rather than the landmarks."""
_FLAGS = {
    "too_few_observers": "--elq_min_observers (keyframes have fewer observers)",
    "too_small_angle": "--elq_min_observation_angle_deg",
    "too_near_or_behind": "--elq_min_distance_from_closest_observer",
    "too_far": "--elq_max_distance_from_closest_observer",
    "too_large_error": "--elq_max_reprojection_error_px",
}


class LandmarkQualityReport(Report):
    """Verdicts on the landmarks of the chosen missions."""

    landmarks: int
    good: int
    bad: int
    unknown: int
    good_before: int
    bad_before: int
    unknown_before: int
    # why landmarks are bad; one may count several times
    too_few_observers: int = 0
    too_small_angle: int = 0
    too_uncertain: int = 0  # predicted covariance
    too_near_or_behind: int = 0
    too_far: int = 0
    too_large_error: int = 0
    note: str = ""

    @property
    def advice(self) -> str:
        """Name the criterion that most landmarks fail if most of them are bad."""
        if self.bad <= _MANY_BAD * max(self.landmarks, 1):
            return ""
        criterion = max(_FLAGS, key=lambda name: getattr(self, name))
        return (
            f"{100.0 * self.bad / self.landmarks:.0f} % of the landmarks are bad, "
            f"{getattr(self, criterion)} of them for {criterion.replace('_', ' ')}: "
            f"change {_FLAGS[criterion]}, or see `why <landmark>`"
        )


class RetriangulationReport(Report):
    """Number of landmarks with a new position."""

    landmarks: int
    triangulated: int
    too_few_observations: int  # fewer than two observations: position unchanged
    undetermined: int  # parallel rays: position unchanged
    behind_camera: int  # behind an observer: position unchanged
    median_shift_m: float
    quality: LandmarkQualityReport


class TrackReport(Report):
    """New landmarks from feature tracks."""

    tracks: int  # unused tracks of two or more keypoints
    landmarks_added: int
    observations_added: int
    undetermined: int  # parallel rays or behind a camera: no landmark made
    retriangulation: RetriangulationReport | None


class LandmarkRemovalReport(Report):
    """Removed landmarks."""

    landmarks_removed: int
    observations_removed: int
    landmarks_left: int
    unknown_left: int


class InvalidObservationReport(Report):
    """Detached observations, by the first reason that applied."""

    observations: int
    twice_in_frame: int
    behind_camera: int
    too_large_error: int
    landmarks_added: int  # from detached observations of one track
    observations_reattached: int
    landmarks_without_observations: int  # landmarks that lost observations
