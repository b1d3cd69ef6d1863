"""Report of a run over a recording."""

import dataclasses
from pathlib import Path

from maplab_py.report import Report


@dataclasses.dataclass(frozen=True)
class StageTime:
    """Elapsed time of one stage of a frame."""

    stage: str
    median_ms: float
    p99_ms: float


@dataclasses.dataclass(frozen=True)
class EstimatorStart:
    """One start of the estimator, which begins a mission."""

    time_s: float  # after the beginning of the recording, as flags count
    waited_s: float  # since the first frame, or since the estimator was lost
    reason: str  # why it had to start


@dataclasses.dataclass(frozen=True)
class LocalizationSummary:
    """Quality of the localisation of a recording."""

    map_name: str
    mode: str
    map_landmarks: int
    localized_share: float  # of all frames
    first_localized_s: float | None  # after the first frame; None = never
    queries: int
    answers_by_index: int
    answers_by_tracking: int
    matches: int
    starts: int  # of T_G_M
    disagreeing: int
    late: int
    refused: dict[str, int]  # answers of the index, by reason
    csv_file: Path | None


class MappingReport(Report):
    """Estimates from a recording."""

    recording: str
    duration_s: float  # from the first to the last frame
    frames: int
    estimated_frames: int
    distance_m: float
    real_time_factor: float  # duration of the recording / elapsed time
    starts: tuple[EstimatorStart, ...]
    missions: int
    vertices: int
    landmarks: int
    good_landmarks: int
    frame_times: tuple[StageTime, ...]
    map_key: str
    map_folder: Path | None
    poses_file: Path | None
    notes: tuple[str, ...]
    problem: str = ""
    localization: LocalizationSummary | None = None

    @property
    def failure(self) -> str:
        """Return why the run ended early, empty if it did not."""
        return self.problem
