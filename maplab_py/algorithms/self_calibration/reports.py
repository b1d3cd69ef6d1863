"""Reports of the self-calibration commands."""

import dataclasses
from pathlib import Path

from maplab_py.report import Report


@dataclasses.dataclass(frozen=True)
class ParameterEstimate:
    """An estimated parameter; poses and rotations as changes."""

    parameter: str
    unit: str
    before: float = dataclasses.field(metadata={"deviation": "sigma"})
    after: float = dataclasses.field(metadata={"deviation": "sigma"})
    sigma: float = dataclasses.field(metadata={"deviation": "sigma"})
    change_in_sigmas: float = dataclasses.field(metadata={"deviation": 1.0})
    verdict: str


class SelfCalibrationReport(Report):
    """Result of a calibration and its uncertainty."""

    parameters: tuple[ParameterEstimate, ...]
    unobservable: tuple[str, ...]  # directions that the data do not determine
    without_scale: tuple[str, ...]  # partitions left out: their metric scale is unobservable
    segments: int
    partitions: int
    gaps: int  # between segments of a mission, bridged by the bias random walk
    keyframes: int
    landmarks: int
    observations: int
    inconsistent_landmarks: int  # rejected: their tracks do not observe one point
    keypoint_noise_factor: float  # measured keypoint noise over the map's
    track_deviation_factor: float  # cluster-robust over formal deviations, median
    cost_before: float
    cost_after: float
    chi_square_per_freedom: float  # about 1 when the sigmas of the measurements are right
    iterations: int
    termination: str
    seconds_pose: float
    seconds_solve: float

    @property
    def advice(self) -> str:
        """Return how to confirm a doubtful change, or how to use the calibration."""
        if any(row.verdict.startswith("not confirmed") for row in self.parameters):
            return "changes are not confirmed: self_calibrate --parts=4, or record a longer session"
        if any("disagree" in row.verdict for row in self.parameters):
            return "parts of the data disagree: check_recording, or fewer --sc_states"
        return "optvi adjusts the map to the calibration" if self.parameters else ""


@dataclasses.dataclass(frozen=True)
class KeptSegment:
    """A segment of the database."""

    mission: str
    begin_s: float  # since the mission's first segment
    duration_s: float
    keyframes: int
    landmarks: int
    kept_for: str
    gyro_rms_degps: float
    accel_change_mps2: float
    unobservable: int


class CollectionReport(Report):
    """Segments that were evaluated, and the database afterwards."""

    segments_evaluated: int
    segments_kept: int
    from_this_map: int
    dropped: int  # segments of the database that were less informative
    seconds_per_segment: float
    segments: tuple[KeptSegment, ...]


@dataclasses.dataclass(frozen=True)
class SegmentScore:
    """Scores of a segment; less is more informative."""

    mission: str
    start_ns: int
    end_ns: int
    imu: float
    camera: float
    extrinsics: float
    unobservable: int
    gyro_rms_degps: float
    accel_change_mps2: float


@dataclasses.dataclass(frozen=True)
class ParameterReference:
    """Reference deviation of a parameter given one segment."""

    parameter: str
    unit: str
    sigma: float


class InformationReport(Report):
    """Information of all segments."""

    metric: str
    segments: tuple[SegmentScore, ...]
    reference: tuple[ParameterReference, ...]
    seconds_per_segment: float


@dataclasses.dataclass(frozen=True)
class ComparedParameter:
    """A parameter of both calibrations."""

    parameter: str
    unit: str
    first: float = dataclasses.field(metadata={"title": "map"})
    second: float = dataclasses.field(metadata={"title": "given"})
    difference: float


class CalibrationComparison(Report):
    """Differences between two calibrations."""

    parameters: tuple[ComparedParameter, ...]
    largest_pixel_shift_px: float  # between the images of a ray
    largest_camera_turn_deg: float
    largest_camera_shift_m: float


@dataclasses.dataclass(frozen=True)
class DatabaseTable:
    """A table of a segment database."""

    table: str
    segments: int
    best_score: float
    worst_score: float


@dataclasses.dataclass(frozen=True)
class DatabaseParameter:
    """Deviations of a parameter given one segment."""

    parameter: str
    reference_sigma: float  # median over segments
    best_sigma: float  # given the best segment


class DatabaseReport(Report):
    """Contents of a segment database."""

    file: Path
    metric: str
    selection: str
    capacity: int  # segments per table
    sessions: int
    keyframes: int
    landmarks: int
    imu_samples: int
    tables: tuple[DatabaseTable, ...]
    parameters: tuple[DatabaseParameter, ...]
    segments: tuple[KeptSegment, ...]


@dataclasses.dataclass(frozen=True)
class PrunedSegment:
    """A segment that was tested."""

    mission: str
    first_vertex: str
    distance: float
    limit: float
    chi_square_per_freedom: float
    outdated: bool


class PruneReport(Report):
    """Removal of segments from a database."""

    segments_before: int
    segments_after: int
    tested: tuple[PrunedSegment, ...]
