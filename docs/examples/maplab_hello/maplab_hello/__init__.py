"""An example plugin: one command that reads a map, one that changes it."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import numpy as np

from maplab_py.plugin import CommandContext, Message, Report, UserError, command, option


@dataclasses.dataclass(frozen=True)
class FarLandmarkOptions:
    """Each field becomes a flag: --far_distance_m."""

    flag_prefix: ClassVar[str] = "far_"
    distance_m: float = option(20.0, help="Landmarks beyond this are far.", unit="m")

    def __post_init__(self) -> None:
        """Refuse what makes no sense."""
        if self.distance_m <= 0.0:
            raise ValueError("--far_distance_m must be greater than 0")


@dataclasses.dataclass(frozen=True)
class FarLandmarks(Report):
    """A report: its fields are printed as a table, or as JSON with --json."""

    landmarks: int
    far: int
    largest_distance_m: float


@command("count_far_landmarks", "cfl", example="cfl --far_distance_m=5")
def count_far_landmarks(
    context: CommandContext,
    *,
    options: FarLandmarkOptions = FarLandmarkOptions(),
) -> FarLandmarks:
    """Count the landmarks that are far from the vertex that stores them."""
    distance = np.linalg.norm(context.vi_map.landmarks.p_I, axis=1)
    far = int(np.count_nonzero(distance > options.distance_m))
    return FarLandmarks(len(distance), far, float(distance.max(initial=0.0)))


@command("rename_description", example="rename_description --text='office, second floor'")
def rename_description(context: CommandContext, *, text: str) -> Message:
    """Give the map another description.

    Args:
        text: The new description.
    """
    if not text:
        raise UserError("rename_description: --text is empty")
    vi_map = context.vi_map
    metadata = dataclasses.replace(vi_map.metadata, description=text)
    context.commit(vi_map.replace(metadata=metadata))  # undo brings the old one back
    return Message(f"the map is now described as '{text}'")
