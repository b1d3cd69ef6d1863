"""Report of a comparison of two maps."""

from __future__ import annotations

import dataclasses

from maplab_py.report import Report


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


@dataclasses.dataclass(frozen=True)
class MapComparisonReport(Report):
    """How two maps differ. `is_identical`: every number of every table and all sensors are equal."""

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
