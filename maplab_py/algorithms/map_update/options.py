"""Options and reports of map updates."""

import dataclasses
from typing import Self

from maplab_py.options import Options, option
from maplab_py.report import Report


class EvidenceOptions(Options):
    """Evidence for a map."""

    gather_evidence: bool = False
    """Note in the map what the session should have seen and saw"""


class UpdateOptions(Options, prefix=""):
    """Budget of a map, and when landmarks count as vanished."""

    max_landmarks: int = option(0, ge=0)
    """Largest number of landmarks after the update; 0 = no limit"""
    max_vertices: int = option(0, ge=0)
    """Largest number of vertices after the update; 0 = no limit"""
    max_map_mb: float = option(0.0, ge=0, unit="MB")
    """Largest size of the map in memory after the update; 0 = no limit"""
    vanished_below: float = option(0.05, ge=0, le=1)
    """Landmarks that exist with less than this probability are removed, never after a single miss"""
    observers_kept: int = option(3, ge=1, le=8)
    """Number of vertices that a landmark should keep as observers when vertices are removed"""


class EvidenceReport(Report):
    """Outcome of one session for the landmarks of others."""

    session: str  # beginning of the mission's id
    date: str
    predicted: int  # landmarks that it should have seen
    matched: int
    false_match: float  # probability that a random landmark would have been matched
    detection: float  # mean probability that an existing landmark is matched
    probably_vanished: int  # landmarks that now exist with a probability below one half


@dataclasses.dataclass(frozen=True)
class Change:
    """A region that changed."""

    change: str  # vanished, appeared or moved
    x_m: float  # its middle in G
    y_m: float
    z_m: float
    size_m: float
    missing: int  # landmarks that only one side saw
    around: int  # landmarks there that both should have seen
    after: str  # dates of the sessions between which it changed
    until: str
    to_m: str  # where it moved to, in G
    view_before: str  # vertices whose images show it best before and after
    view_after: str


class ChangeReport(Report):
    """Regions that changed between the earlier and the later sessions."""

    changes: tuple[Change, ...]
    earlier: str  # begin of the last earlier session
    later: str  # begin of the first later session
    landmarks_missed: int  # of the earlier sessions, by the later ones, changed or not
    landmarks_new: int  # of the later sessions, not seen by the earlier ones
    note: str = ""


class GatheringReport(Report):
    """Evidence of the sessions of a map, and how probable it is that landmarks exist."""

    sessions: tuple[EvidenceReport, ...]
    landmarks: int
    with_evidence: int
    detection: float  # mean probability that an existing landmark is matched
    date: str  # of the probabilities
    # landmarks with evidence by the probability that they exist at the date
    certain: int  # above 0.9
    likely: int  # 0.5 to 0.9
    unlikely: int  # 0.1 to 0.5
    vanished: int  # below 0.1
    note: str = ""


class MapUpdateReport(Report):
    """Contents of the map before and after an update."""

    sessions: tuple[EvidenceReport, ...]
    vertices_before: int
    vertices_added: int
    vertices_removed: int
    vertices_after: int
    landmarks_before: int
    landmarks_added: int
    landmarks_merged: int
    landmarks_vanished: int  # removed because they hardly exist any more
    landmarks_thinned: int  # removed because others are more useful
    landmarks_after: int
    missions_removed: int  # none of their vertices stayed
    missions_without_imu: int  # thinned: their poses are joined by odometry edges
    megabytes_before: float
    megabytes_after: float
    localized_before: float  # share of the sessions' vertices, in the map before
    localized_after: float  # and in the map after, without what they saw themselves
    notes: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class UpdateRecord:
    """One update in the chronicle of a map."""

    date: str  # begin of the session
    session: str  # beginning of the mission's id
    vertices_added: int
    vertices_removed: int
    landmarks_added: int
    landmarks_vanished: int
    landmarks_thinned: int
    megabytes_before: float
    megabytes_after: float
    localized_before: float
    localized_after: float

    @classmethod
    def of(cls, report: MapUpdateReport) -> Self:
        """Return the record of an update."""
        newest = max(report.sessions, key=lambda line: line.date)
        names = [field.name for field in dataclasses.fields(cls)[2:]]
        values = {name: round(getattr(report, name), 4) for name in names}
        return cls(date=newest.date, session=newest.session, **values)


class ChronicleReport(Report):
    """Updates of a map, the oldest first."""

    updates: tuple[UpdateRecord, ...]
    states: int  # earlier maps that map_at returns to
    stored_kb: float  # of the differences that lead back
