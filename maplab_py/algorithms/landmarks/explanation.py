"""Explanation of a landmark's quality: the criteria of `quality` with values and thresholds."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.algorithms.landmarks.options import LandmarkQualityOptions
from maplab_py.algorithms.landmarks.quality import criteria
from maplab_py.report import Report
from maplab_py.vimap import LandmarkQuality, VIMap
from maplab_py.vimap.ids import to_hex


@dataclasses.dataclass(frozen=True)
class Criterion:
    """One criterion for a landmark."""

    criterion: str
    value: str
    wanted: str
    result: str  # passed, failed or not checked
    flag: str


@dataclasses.dataclass(frozen=True)
class LandmarkExplanation(Report):
    """The criteria of a landmark's quality."""

    landmark: str
    mission: str
    quality: str  # as stored in the map
    observations: int
    criteria: tuple[Criterion, ...]
    summary: str = dataclasses.field(metadata={"is_prose": True})


def explain_landmark(
    vi_map: VIMap, landmark: int, options: LandmarkQualityOptions
) -> LandmarkExplanation:
    """Return the criteria for a landmark (row) with the thresholds of the options.

    Raises:
        MapError: A mission's camera rig or IMU is not in sensors.yaml.
    """
    lines = tuple(
        Criterion(gate.name, *gate.describe(0), gate.flag)
        for gate in criteria(vi_map, np.array([landmark]), options)
        if gate.applies[0]
    )
    failed = [line.criterion for line in lines if line.result == "failed"]
    verdict = "bad: it fails " + ", ".join(failed) if failed else "good"
    return LandmarkExplanation(
        to_hex(vi_map.landmarks.id[landmark]),
        to_hex(vi_map.missions.id[vi_map.vertices.mission[vi_map.landmarks.vertex[landmark]]])[:8],
        LandmarkQuality(int(vi_map.landmarks.quality[landmark])).name.lower(),
        int(np.diff(vi_map.observation_start)[landmark]),
        lines,
        f"With these thresholds the landmark is {verdict}.",
    )
