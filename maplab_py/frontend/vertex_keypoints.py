"""Keypoints of a vertex: tracks with descriptors."""

from __future__ import annotations

import numpy as np

from maplab_py.array_types import U8, Mask
from maplab_py.interop.recordings.protocol import TrackedFrame
from maplab_py.vision.features.description import describe
from maplab_py.vision.features.extractors import KINDS
from maplab_py.vision.tracking.tracks import CameraTracks, TrackedImages


def described_frames(
    tracked: TrackedImages, images: tuple[U8, ...], stamp_ns: int, descriptor_type: str = ""
) -> tuple[TrackedFrame, ...]:
    """Return the tracks of each camera with the descriptors of their image patches.

    Keypoints so near to the border that they have no descriptor are left out.

    Args:
        tracked: Tracks of all cameras.
        images: Images of all cameras.
        stamp_ns: Time of the images.
        descriptor_type: Name of the descriptors; empty = those that the tracks are to get.

    Raises:
        UserError: The descriptors are those of a network that is not installed.
    """
    return tuple(
        _described(row, tracks, image, stamp_ns, descriptor_type or tracked.descriptor_type)
        for row, (tracks, image) in enumerate(zip(tracked.cameras, images, strict=True))
    )


def check_descriptors_exist(descriptor_type: str) -> None:
    """Check, before a run, that keypoints can be described.

    Raises:
        UserError: The descriptors are those of a network that is not installed.
    """
    if descriptor_type == "xfeat":
        from maplab_py.vision.features.learned.xfeat import installed_xfeat

        installed_xfeat()


def _described(
    camera: int, tracks: CameraTracks, image: U8, stamp_ns: int, descriptor_type: str
) -> TrackedFrame:
    kind = KINDS[descriptor_type]
    if descriptor_type == "xfeat":
        from maplab_py.vision.features.learned.xfeat import installed_xfeat

        descriptors: U8 = installed_xfeat().describe(image, tracks.uv_px).view(np.uint8)
        is_described: Mask = np.ones(len(tracks), dtype=np.bool_)
    else:
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
        descriptor_size=np.full(len(kept), kind.size, dtype=np.int32),
        feature_type=kind.feature_type,
        depth=kind.depth,
    )
