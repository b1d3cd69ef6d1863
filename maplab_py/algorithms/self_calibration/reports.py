"""What the self-calibration commands tell their user."""

from __future__ import annotations

import dataclasses

from maplab_py.report import Report


@dataclasses.dataclass(frozen=True)
class ParameterEstimate:
    """One parameter; poses and rotations as a change from before."""

    parameter: str
    unit: str
    before: float
    after: float
    sigma: float
    change_in_sigmas: float
    verdict: str


@dataclasses.dataclass(frozen=True)
class SelfCalibrationReport(Report):
    """What a calibration found and how far it can be trusted."""

    parameters: tuple[ParameterEstimate, ...]
    unobservable: tuple[str, ...]  # directions that the data do not determine
    without_scale: tuple[str, ...]  # left out: the device only turns there and lengths are lost
    segments: int
    partitions: int
    gaps: int  # between segments of a mission, bridged by the walk of the biases
    keyframes: int
    landmarks: int
    observations: int
    inconsistent_landmarks: int  # left out: their tracks are not of one point
    keypoint_noise_factor: float  # noise of the keypoints over what the map says
    track_deviation_factor: float  # deviations by tracks over those by single observations, median
    cost_before: float
    cost_after: float
    chi_square_per_freedom: float  # about 1 when the sigmas of the measurements are right
    iterations: int
    termination: str
    seconds_pose: float
    seconds_solve: float


@dataclasses.dataclass(frozen=True)
class KeptSegment:
    """A segment that the database keeps."""

    mission: str
    begin_s: float  # since the mission's first segment
    duration_s: float
    keyframes: int
    landmarks: int
    kept_for: str
    gyro_rms_degps: float
    accel_change_mps2: float
    unobservable: int


@dataclasses.dataclass(frozen=True)
class CollectionReport(Report):
    """What collecting found and what the database holds now."""

    segments_evaluated: int
    segments_kept: int
    from_this_map: int
    dropped: int  # less informative ones that were in the database before
    seconds_per_segment: float
    segments: tuple[KeptSegment, ...]


@dataclasses.dataclass(frozen=True)
class SegmentScore:
    """The information of one segment; less is more."""

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
    """The usual deviation of a parameter that one segment leaves."""

    parameter: str
    unit: str
    sigma: float


@dataclasses.dataclass(frozen=True)
class InformationReport(Report):
    """Information of all segments."""

    metric: str
    segments: tuple[SegmentScore, ...]
    reference: tuple[ParameterReference, ...]
    seconds_per_segment: float


@dataclasses.dataclass(frozen=True)
class ComparedParameter:
    """One parameter of both."""

    parameter: str
    unit: str
    first: float
    second: float
    difference: float


@dataclasses.dataclass(frozen=True)
class CalibrationComparison(Report):
    """What differs between two calibrations."""

    parameters: tuple[ComparedParameter, ...]
    largest_pixel_shift_px: float  # of a ray of the first in the second, over all images
    largest_camera_turn_deg: float
    largest_camera_shift_m: float
