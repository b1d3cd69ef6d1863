"""The tracks of one camera that the tracker follows."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.array_types import F32, F64, I64, Mask
from maplab_py.vision.tracking.patch_kernels import SIDE_PX


@dataclasses.dataclass(frozen=True, eq=False)
class LiveTracks:
    """Tracks at the latest image of a camera."""

    uv: F64  # (K, 2) of the prepared image
    ray: F64  # (K, 3) unit, in the camera
    track_id: I64  # (K,)
    num_frames: I64  # (K,)
    distance_m: F64  # (K,) along the ray, NaN = unknown
    patch: F32  # (K, S, S) about the keypoint in an earlier image
    warp: F64  # (K, 2, 2) from offsets in the patch to offsets in the latest image

    def __len__(self) -> int:
        return len(self.track_id)

    def __getitem__(self, rows: Mask | I64) -> LiveTracks:
        columns = (getattr(self, field.name)[rows] for field in dataclasses.fields(self))
        return LiveTracks(*columns)

    def joined(self, others: LiveTracks) -> LiveTracks:
        """Return these tracks followed by others."""
        names = [field.name for field in dataclasses.fields(self)]
        pairs = ((getattr(self, name), getattr(others, name)) for name in names)
        return LiveTracks(*(np.concatenate(pair) for pair in pairs))

    def at(self, uv: F64, ray: F64) -> LiveTracks:
        """Return the tracks an image later."""
        return dataclasses.replace(self, uv=uv, ray=ray, num_frames=self.num_frames + 1)

    def compared_with(self, patch: F32, warp: F64) -> LiveTracks:
        """Return the tracks with other patches (K, S, S) and warps (K, 2, 2)."""
        return dataclasses.replace(self, patch=patch, warp=warp)

    @classmethod
    def new(cls, uv: F64, ray: F64, first_id: int) -> LiveTracks:
        """Return tracks that begin, numbered from an id on."""
        count = len(uv)
        ids = np.arange(first_id, first_id + count, dtype=np.int64)
        patch = np.zeros((count, SIDE_PX, SIDE_PX), dtype=np.float32)
        warp = np.tile(np.eye(2), (count, 1, 1))
        return cls(
            uv, ray, ids, np.ones(count, dtype=np.int64), np.full(count, np.nan), patch, warp
        )

    @classmethod
    def none(cls) -> LiveTracks:
        """Return no tracks."""
        return cls.new(np.zeros((0, 2)), np.zeros((0, 3)), 0)
