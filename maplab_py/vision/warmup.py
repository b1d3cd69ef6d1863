"""The kernels of place recognition and tracking, compiled before they are needed."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from maplab_py.vision import (
    absolute_pose,
    descriptors,
    index_engines,
    point_covariance,
    rays_and_points,
    track_union,
)
from maplab_py.vision.tracking import tracker

SEARCH = "descriptor search"


def vision_jobs() -> dict[str, Callable[[], None]]:
    """Return by name what compiles kernels that are needed together."""
    return {SEARCH: _compile_search, "feature tracking": tracker.compile_kernels} | {
        pose_job(hypotheses): partial(absolute_pose.compile_kernels, hypotheses)
        for hypotheses in absolute_pose.HYPOTHESES
    }


def pose_job(hypotheses: str) -> str:
    """Return the name of the job for one kind of hypotheses."""
    return f"absolute pose by {hypotheses}"


def _compile_search() -> None:
    """Compile the descriptor indices, and what merging landmarks needs."""
    for module in (index_engines, descriptors, track_union, point_covariance, rays_and_points):
        module.compile_kernels()
