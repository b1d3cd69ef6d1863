"""Options and report of keyframing."""

from __future__ import annotations

import dataclasses

from maplab_py.errors import FlagError
from maplab_py.options import Options
from maplab_py.report import Report


class KeyframingOptions(Options, prefix="kf_"):
    """Criteria for keyframes."""

    distance_threshold_m: float = 0.75
    """Distance from the last keyframe that makes a new one."""
    rotation_threshold_deg: float = 20.0
    """Rotation from the last keyframe that makes a new one."""
    every_nth_vertex: int = 10
    """Make at least every n-th vertex a keyframe."""
    min_shared_landmarks_obs: int = 20
    """Make a keyframe where fewer landmarks are shared with the last one."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        if self.every_nth_vertex < 1:
            raise FlagError("--kf_every_nth_vertex must be at least 1")
        for name in ("distance_threshold_m", "rotation_threshold_deg", "min_shared_landmarks_obs"):
            if getattr(self, name) < 0:
                raise FlagError(f"--kf_{name} must not be negative")


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
