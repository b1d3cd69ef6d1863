"""Options of landmark sparsification; maplab's names and defaults where it has them."""

import dataclasses

from maplab_py.options import Options, option
from maplab_py.report import Report

METHODS = ("ilp", "greedy", "most_observed", "random")


class SparsificationOptions(Options, prefix="sparsification_"):
    """Method and parameters of the selection of landmarks."""

    method: str = option("ilp", choices=METHODS)
    """ilp (integer programme), greedy (cover), or, for comparison, most_observed or random."""
    min_keypoints_per_keyframe: int = option(30, ge=0)
    """Number of landmarks that every keyframe should still observe"""
    weighted: bool = False
    """Weight a landmark by the probability of matching it again, which increases with the number of observing
    vertices; otherwise all weights are equal (Schneider 2019, section 4)"""
    slack_levels: int = option(2, ge=1, le=8)
    """Number of levels of the cost of missing landmarks, which doubles from level to level; 1 = constant
    cost, as in Schneider 2019"""
    descriptor_dev_scoring_threshold: float = option(10.0, gt=0)
    """Mean distance of a landmark's descriptors from their majority, in bits of 384, above which its score
    falls."""
    exact_up_to: int = option(2000, ge=0)
    """Largest number of landmarks for which the integer programme is solved exactly"""
    landmarks_per_part: int = option(60000, ge=100)
    """Largest number of landmarks of a part; larger maps are split along the co-visibility graph"""
    seed: int = option(0, ge=0)
    """Seed of the random choice."""


@dataclasses.dataclass(frozen=True)
class CoverageOfMission:
    """Good landmarks per keyframe of one mission."""

    mission: str  # beginning of its id
    keyframes: int
    min_before: int
    median_before: float
    min_after: int
    median_after: float
    below_wanted: int  # keyframes that could have had the wanted number and see fewer


@dataclasses.dataclass(frozen=True)
class KeyframeCoverage:
    """Good landmarks that one keyframe sees."""

    vertex: str
    before: int
    after: int


class SparsificationReport(Report):
    """Remaining landmarks and coverage of the keyframes."""

    landmarks_before: int
    good_landmarks: int
    landmarks_after: int
    observations_before: int
    observations_after: int
    keyframes: int
    wanted_per_keyframe: int
    below_wanted: int  # keyframes that could have had the wanted number and see fewer
    method: str
    parts: int
    objective: float  # score and coverage value of the selection
    bound: float  # upper bound on the objective; NaN if unknown
    missions: tuple[CoverageOfMission, ...]
    worst_keyframes: tuple[KeyframeCoverage, ...]
    note: str = ""
