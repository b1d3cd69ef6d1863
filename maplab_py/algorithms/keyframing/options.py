"""Options and report of keyframing."""

from maplab_py.options import Options, option
from maplab_py.report import Report


class KeyframingOptions(Options, prefix="kf_"):
    """Criteria for keyframes."""

    distance_threshold_m: float = option(0.75, ge=0)
    """Distance from the last keyframe that makes a new one."""
    rotation_threshold_deg: float = option(20.0, ge=0)
    """Rotation from the last keyframe that makes a new one."""
    every_nth_vertex: int = option(10, ge=1)
    """Make at least every n-th vertex a keyframe."""
    min_shared_landmarks_obs: int = option(20, ge=0)
    """Make a keyframe where fewer landmarks are shared with the last one."""


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
