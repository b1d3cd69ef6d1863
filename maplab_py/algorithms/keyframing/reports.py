"""Report of heuristic keyframing."""

from __future__ import annotations

import dataclasses

from maplab_py.report import Report


@dataclasses.dataclass(frozen=True)
class KeyframingReport(Report):
    """Keyframes by the first reason that applied, and data removed with other vertices."""

    vertices_before: int
    vertices_after: int
    # keyframes by reason
    mission_ends: int
    every_nth: int
    few_shared_landmarks: int
    absolute_pose: int
    loop_closure: int
    distance: int
    rotation: int
    # data removed with vertices
    observations_removed: int
    landmarks_moved: int
    landmarks_undetermined: int  # left with fewer than two observations
    imu_edges_dropped: int
    transformation_edges_dropped: int
    resources_removed: int
    note: str = ""
