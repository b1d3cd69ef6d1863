"""Keypoints of a vertex: tracks with descriptors."""

from __future__ import annotations

import numpy as np

from maplab_py.array_types import U8
from maplab_py.interop.recordings.protocol import TrackedFrame
from maplab_py.vision.features.description import describe
from maplab_py.vision.tracking.tracks import CameraTracks


def described_frames(
    cameras: tuple[CameraTracks, ...], images: tuple[U8, ...], stamp_ns: int
) -> tuple[TrackedFrame, ...]:
    """Return the tracks of each camera with the descriptors of their image patches.

    Keypoints so near to the border that they have no descriptor are left out.
    """
    return tuple(
        _described(row, tracks, image, stamp_ns)
        for row, (tracks, image) in enumerate(zip(cameras, images, strict=True))
    )


def _described(camera: int, tracks: CameraTracks, image: U8, stamp_ns: int) -> TrackedFrame:
    descriptors, is_described = describe(image, tracks.uv_px, tracks.scale)
    kept = tracks[is_described]
    return TrackedFrame(
        camera=camera,
        stamp_ns=stamp_ns,
        uv_px=kept.uv_px,
        sigma_px=kept.sigma_px,
        scale=kept.scale,
        track_id=kept.track_id.astype(np.int32),
        descriptor=descriptors[is_described],
        descriptor_size=np.full(len(kept), descriptors.shape[1], dtype=np.int32),
    )
