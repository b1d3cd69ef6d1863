"""Report of trajectory evaluation."""

import dataclasses
from typing import Any

from maplab_py.report import Report, view

_LARGEST_RATIO = 10.0
"""Larger changes are shown without percents."""


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
    """Errors of a single mission that is aligned separately."""

    mission_id: str
    matched: int
    ape_rmse_m: float | None  # None: too few vertices, or all on a line


@dataclasses.dataclass(frozen=True)
class BaselineErrors:
    """RMSE of another state of the map against the same ground truth with the same options."""

    name: str
    ape_m: float
    ape_deg: float | None
    ape_sim3_m: float | None
    rpe_m: float | None
    rpe_deg: float | None


class TrajectoryEvaluationReport(Report):
    """Errors of the vertices against ground truth."""

    ground_truth: str
    alignment: str
    vertices: int
    matched: int
    without_ground_truth: int  # outside its span, or in one of its gaps
    ape_m: ErrorStatistics
    ape_deg: ErrorStatistics | None  # None, like rpe: the ground truth has positions only
    ape_sim3_m: ErrorStatistics | None  # None: the scale cannot be determined
    scale: float | None  # ground truth / map
    body_rotation_deg: (
        float | None
    )  # constant rotation between ground truth's body frame and the IMU
    rpe_m: ErrorStatistics | None  # None: no segment of the wanted length
    rpe_deg: ErrorStatistics | None
    rpe_pieces: str  # description of the segments
    missions: tuple[MissionEvaluation, ...]
    baseline: BaselineErrors | None = None
    notes: tuple[str, ...] = ()  # other readings of the ground truth that fit much better

    def as_baseline(self, name: str) -> BaselineErrors:
        """Return the errors that a later evaluation is compared with."""
        errors = (self.ape_deg, self.ape_sim3_m, self.rpe_m, self.rpe_deg)
        rmse = (None if error is None else error.rmse for error in errors)
        return BaselineErrors(name, self.ape_m.rmse, *rmse)

    def display(self) -> Any:
        """Return one table of the errors and a sentence on how they were computed."""
        kinds = ("ape_m", "ape_deg", "ape_sim3_m", "rpe_m", "rpe_deg")
        names = ("APE [m]", "APE [deg]", "APE, Sim(3) [m]", "RPE [m]", "RPE [deg]")
        lines = []
        for kind, name in zip(kinds, names, strict=True):
            statistics: ErrorStatistics | None = getattr(self, kind)
            if statistics is not None:
                before = None if self.baseline is None else getattr(self.baseline, kind)
                change = _change(statistics.rmse, before)
                numbers = {n: getattr(statistics, n) for n in ("rmse", "median", "max")}
                lines.append(view(error=name, **numbers, change=change))
        head = {"rmse": "APE RMSE, aligned alone [m]"}
        missions = [
            view(head, mission=m.mission_id, vertices=m.matched, rmse=m.ape_rmse_m)
            for m in self.missions
        ]
        return view(
            {"errors": "", "missions": ""},
            errors=lines,
            missions=missions if len(missions) > 1 else (),
            summary=" ".join(self._sentences()),
        )

    def _sentences(self) -> list[str]:
        outside = self.without_ground_truth
        left_out = f" ({outside} of the map have none)" if outside else ""
        scale = "" if self.scale is None else f", scale {self.scale:.5f}"
        turned = "positions only"
        if self.body_rotation_deg is not None:
            turned = (
                f"RPE over {self.rpe_pieces}, body frames {self.body_rotation_deg:.2f} deg apart"
            )
        sentences = [
            f"{self.matched} vertices with ground truth{left_out}, "
            f"alignment {self.alignment}{scale}, {turned}."
        ]
        sentences += [f"{note[0].upper()}{note[1:]}." for note in self.notes]
        if self.baseline is not None:
            sentences.append(f"Change of the RMSE since {self.baseline.name}.")
        return sentences


def _change(rmse: float, before: float | None) -> str:
    """Return the difference of an error in its unit and in percent."""
    if before is None:
        return ""
    difference = rmse - before
    is_comparable = before > 0.0 and abs(difference) < _LARGEST_RATIO * before
    share = f" ({100.0 * difference / before:+.1f} %)" if is_comparable else ""
    return f"{difference:+.4f}{share}" if difference else "none"


@dataclasses.dataclass(frozen=True)
class LocalizationErrors:
    """Errors of one file."""

    file: str
    frames: int  # with ground truth
    localized_share: float  # of them
    first_localized_s: float | None  # after the first frame; None = never
    median_m: float | None  # None: never localised
    std_m: float | None
    rmse_m: float | None
    largest_m: float | None
    median_deg: float | None
    largest_step_m: float | None  # by which the error changes between two outputs
    median_step_m: float | None


class LocalizationEvaluationReport(Report):
    """Errors of poses in a map."""

    ground_truth: str
    map_alignment: str
    files: tuple[LocalizationErrors, ...]

    @property
    def failure(self) -> str:
        """Return the failure if nothing was localised."""
        if any(errors.localized_share > 0.0 for errors in self.files):
            return ""
        return "no frame with ground truth was localised"


@dataclasses.dataclass(frozen=True)
class RowCounts:
    """Rows of a table in both maps, by their ids."""

    what: str
    in_both: int
    only_in_first: int = dataclasses.field(metadata={"title": "only in this map"})
    only_in_second: int = dataclasses.field(metadata={"title": "only in the other"})


@dataclasses.dataclass(frozen=True)
class Difference:
    """Differences of values that both maps have."""

    compared: int
    rmse: float
    largest: float

    @property
    def is_empty(self) -> bool:
        """Whether the maps have no such values in common."""
        return self.compared == 0


class MapComparisonReport(Report):
    """Differences of two maps. `is_identical`: every number of every table and all sensors are equal."""

    rows: tuple[RowCounts, ...] = dataclasses.field(metadata={"title": "rows"})
    position_m: Difference  # of vertices in G
    rotation_deg: Difference
    landmark_position_m: Difference  # in G
    keypoint_px: Difference
    time_ns: Difference  # of vertices
    frames_with_other_keypoints: int
    landmarks_of_other_quality: int
    descriptors_differing: int
    sensors_differing: tuple[str, ...]
    is_identical: bool
    in_words: str = ""
