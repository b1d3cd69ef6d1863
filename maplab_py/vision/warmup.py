"""The kernels of place recognition and tracking, compiled before they are needed."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from maplab_py.vimap.descriptors import FeatureType
from maplab_py.vision import (
    absolute_pose,
    descriptors,
    epipolar_matching,
    index_engines,
    point_covariance,
    rays_and_points,
    track_union,
)
from maplab_py.vision.descriptor_kind import DescriptorKind
from maplab_py.vision.tracking import tracker

SEARCH = "descriptor search"


def vision_jobs() -> dict[str, Callable[[], None]]:
    """Return by name what compiles kernels that are needed together."""
    return {
        SEARCH: _compile_search,
        "feature tracking": tracker.compile_kernels,
        "descriptors of numbers": _compile_numbers,
    } | {
        pose_job(hypotheses): partial(absolute_pose.compile_kernels, hypotheses)
        for hypotheses in absolute_pose.HYPOTHESES
    }


def pose_job(hypotheses: str) -> str:
    """Return the name of the job for one kind of hypotheses."""
    return f"absolute pose by {hypotheses}"


def _compile_numbers() -> None:
    """Compile the search of descriptors that are not binary, and the tracks of extracted features."""
    index_engines.compile_kernels(DescriptorKind(8, FeatureType.SIFT))
    descriptors.compile_kernels(np.int8)
    epipolar_matching.compile_kernels()


def _compile_search() -> None:
    """Compile the descriptor indices, and what merging landmarks needs."""
    for module in (index_engines, descriptors, track_union, point_covariance, rays_and_points):
        module.compile_kernels()
