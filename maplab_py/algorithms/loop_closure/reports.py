"""Verdicts on loop closures, and the reports of the commands that find, list and remove them."""

import dataclasses
from enum import Enum
from typing import Any

from maplab_py.report import Report, view


class Verdict(Enum):
    """Outcome of a candidate."""

    ACCEPTED = "accepted"
    FEW_INLIERS = "too few inliers"
    LOW_RATIO = "inlier ratio too low"
    TILTED = "gravity deviates"
    IMPLAUSIBLE = "exceeds plausible drift"
    AMBIGUOUS = "looks the same as another place"
    NO_SUPPORT = "no closures nearby agree"
    CONTRADICTED = "closures nearby disagree"
    REMOVED = "removed by hand"
    UNCERTAIN = "rotation too uncertain"
    SMALL_OVERLAP = "clouds overlap too little"
    BAD_FIT = "clouds do not fit"
    DEGENERATE = "clouds do not fix the position"


OF_CLOUDS = (Verdict.SMALL_OVERLAP, Verdict.BAD_FIT, Verdict.DEGENERATE)
"""Verdicts of gates that only closures between clouds have."""


GAP = "the closure corrects too much: relax first"
UNKNOWN_BASE_FRAME = "between missions without known base frames: anchor first"
"""Reasons for which landmarks are not merged."""


class LoopClosureReport(Report):
    """Counts of a search and the use of its result."""

    query_vertices: int = 0
    database_landmarks: int = 0
    descriptor_matches: int = 0
    candidates: int = 0  # pairs of a query vertex and a place that were verified
    accepted: int = 0
    accepted_vertices: int = 0
    refused: dict[str, int] = dataclasses.field(default_factory=dict)  # by reason
    missions_joined: tuple[str, ...] = ()  # "short id - short id: closures"
    largest_correction_m: float = 0.0
    median_correction_m: float = 0.0
    edges_added: int = 0
    landmarks_merged: int = 0
    observations_moved: int = 0
    merges_refused: dict[str, int] = dataclasses.field(default_factory=dict)  # by reason
    notes: tuple[str, ...] = ()
    reason: str = dataclasses.field(default="", metadata={"is_prose": True})
    """Reason that nothing was found, merged or added; empty when something was."""

    @property
    def failure(self) -> str:
        """Return why nothing could be searched, or why accepted closures were not used.

        A search that finds no loop is not a failure: the recording may have none.
        """
        could_search = self.database_landmarks > 0
        return "" if could_search and not self.accepted else self.reason

    @property
    def remedy(self) -> str:
        """Return the command that makes the refused merges possible."""
        if not self.failure:
            return ""
        if UNKNOWN_BASE_FRAME in self.merges_refused:
            return "anchor_all_missions"
        return "relax" if GAP in self.merges_refused else ""

    @property
    def advice(self) -> str:
        """Return how to get more closures, or how to use the accepted ones."""
        drifted = self.refused.get(Verdict.IMPLAUSIBLE.value, 0)
        if self.candidates and drifted > self.accepted:
            return f"{drifted} closures correct more than the drift allows: relax first"
        if self.candidates and not self.accepted:
            return "no closure was accepted: lc_report --which=refused --sort_by=near_miss, why"
        if self.landmarks_merged:
            return "landmarks were merged: optvi adjusts the map to them"
        return ""


@dataclasses.dataclass(frozen=True)
class ClosureLine:
    """A closure: the query vertex A was localised in the place around vertex B."""

    id: str
    query: str  # mission
    query_s: float  # time since the mission's first vertex
    place: str
    place_s: float
    matches: int
    inliers: int
    ratio: float
    correction_m: float  # change of the query's position at detection time
    correction_deg: float
    gap_m: float  # distance of the map's current relative pose from the closure
    gap_deg: float
    tilt_deg: float
    support: int  # number of nearby query vertices with consistent closures
    merged: int  # pairs of landmarks whose merge it supports
    verdict: str  # accepted, or the reason for the refusal
    use: str  # merge, edge, relax, anchor; empty if unused
    weight: float  # weight after relaxation, 1 = full


class ClosureReport(Report):
    """The recorded closures of a map."""

    recorded: int
    accepted: int
    refused: dict[str, int]
    largest_gap_m: float  # of accepted ones
    shown: int
    file: str
    closures: tuple[ClosureLine, ...]
    notes: tuple[str, ...] = ()

    def display(self) -> Any:
        """Return the closures with their verdicts in the first columns."""
        reasons = ", ".join(f"{count} {reason}" for reason, count in self.refused.items())
        summary = (
            f"{self.recorded} recorded, {self.accepted} accepted, largest gap "
            f"{self.largest_gap_m:.3f} m; refused: {reasons or 'none'}; {self.shown} shown"
            + (f"; written to {self.file}" if self.file else "")
        )
        names = (
            "id query query_s place place_s inliers verdict weight gap_m correction_m matches "
            "support ratio tilt_deg gap_deg correction_deg merged use"
        )
        lines = [view(**{n: getattr(line, n) for n in names.split()}) for line in self.closures]
        return view({"closures": ""}, closures=lines, summary=summary, notes=self.notes)


class ClosureRemovalReport(Report):
    """Entities removed and restored with closures."""

    closures: tuple[str, ...]  # prefixes of their ids
    edges_removed: int
    landmarks_restored: int
    observations_moved: int
    notes: tuple[str, ...] = ()


class ClosureVerdictReport(Report):
    """Verdicts that a person has given."""

    accepted: tuple[str, ...]  # prefixes of ids
    refused: tuple[str, ...]
    edges_added: int
    edges_removed: int
    landmarks_restored: int
    observations_moved: int
    notes: tuple[str, ...] = ()

    @property
    def advice(self) -> str:
        """Name the command that moves the trajectory."""
        return "relax moves the trajectory by these closures" if self.edges_added else ""


class TrainingReport(Report):
    """Training data of a projection and its separation of landmarks."""

    descriptors: int
    tracks: int
    descriptor_size: int  # bytes
    dimensions: int
    same_distance: float  # median distance of two descriptors of one landmark
    other_distance: float  # of two landmarks
    file: str = ""
