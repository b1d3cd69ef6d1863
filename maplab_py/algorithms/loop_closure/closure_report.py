"""Reports on single loop closures."""

from __future__ import annotations

import dataclasses

from maplab_py.report import Report


@dataclasses.dataclass(frozen=True)
class ClosureLine:
    """One closure: the query vertex A was located in the place around vertex B."""

    id: str
    query: str  # mission
    query_s: float  # time since the mission's first vertex
    place: str
    place_s: float
    matches: int
    inliers: int
    ratio: float
    correction_m: float  # what it wanted to move the query by when it was found
    correction_deg: float
    gap_m: float  # how far the map's present poses are from it
    gap_deg: float
    tilt_deg: float
    support: int  # query vertices nearby whose closures agreed
    merged: int  # pairs of landmarks that it spoke for
    verdict: str  # accepted, or the reason for the refusal
    use: str  # merge, edge, relax, anchor; empty when it served for nothing
    weight: float  # what relaxation left of it, 1 = all


@dataclasses.dataclass(frozen=True)
class ClosureReport(Report):
    """The closures that the map remembers."""

    recorded: int
    accepted: int
    refused: dict[str, int]
    largest_gap_m: float  # of accepted ones
    shown: int
    file: str
    closures: tuple[ClosureLine, ...]
    notes: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class RemovalReport(Report):
    """What removing closures took back."""

    closures: tuple[str, ...]  # beginnings of their ids
    edges_removed: int
    landmarks_restored: int
    observations_moved: int
    notes: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class TrainingReport(Report):
    """What a projection was learned from, and how well it tells landmarks apart."""

    descriptors: int
    tracks: int
    descriptor_size: int  # bytes
    dimensions: int
    same_distance: float  # median distance of two descriptors of one landmark
    other_distance: float  # of two landmarks
    file: str = ""
