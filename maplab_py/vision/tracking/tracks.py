"""Tracked keypoints of the images of a rig at one time."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.array_types import F64, I64, Rows


class CameraTracks(Rows):
    """Tracked keypoints of one camera of a frame set."""

    uv_px: F64  # (K, 2) of the distorted image
    track_id: I64  # (K,) unique in a recording; the same for a point that several cameras see
    sigma_px: F64  # (K,)
    scale: F64  # (K,) diameter [px] of what a descriptor sees, OpenCV's KeyPoint.size
    num_frames: I64  # (K,) frame sets that have seen the track so far, this one included

    @classmethod
    def empty(cls) -> CameraTracks:
        """Return no keypoints."""
        ids = np.zeros(0, dtype=np.int64)
        return cls(np.zeros((0, 2)), ids, np.zeros(0), np.zeros(0), ids)


@dataclasses.dataclass(frozen=True, eq=False)
class TrackedImages:
    """Tracker's statistics of a frame set."""

    time_ns: int
    cameras: tuple[CameraTracks, ...]
    disparity_px: float  # median, turn removed, against the previous set; NaN: nothing was tracked
    is_turn_only: bool  # the tracks agree with a turn without translation
    stage_ms: dict[str, float]  # elapsed time of each stage
    descriptor_type: str = "brisk"  # that the keypoints are to get
