"""Add keypoints to frames and remove them; every block of a frame has descriptors of one kind."""

from typing import Any

import numpy as np

from maplab_py.array_types import F64, I64, Mask, NDArray
from maplab_py.vimap import DescriptorBlock, VIMap, edits
from maplab_py.vimap.table import object_column, starts_of_counts
from maplab_py.vimap.tables import DescriptorLayout, FrameField, Keypoints
from maplab_py.vision.descriptors import DescriptorKind
from maplab_py.vision.features.extension import ExtractedFeatures

_FIELDS = np.uint16(
    FrameField.SIGMA | FrameField.SCALE | FrameField.TRACK_ID | FrameField.LANDMARK_ID
)


def has_kind(vi_map: VIMap, kind: DescriptorKind) -> Mask:
    """Return which frames (F,) have keypoints with descriptors of a kind."""
    return np.array(
        [
            any(_is(block, kind) and block.keypoints for block in blocks or ())
            for blocks in vi_map.frames.descriptor_blocks
        ],
        dtype=np.bool_,
    )


def is_undescribed(vi_map: VIMap) -> Mask:
    """Return which frames (F,) have keypoints, but no descriptors."""
    has_none = [not blocks for blocks in vi_map.frames.descriptor_blocks]
    return np.array(has_none, dtype=np.bool_) & (vi_map.frames.keypoint_count > 0)


def without_kind(vi_map: VIMap, frames: Mask, kind: DescriptorKind) -> VIMap:
    """Remove the keypoints of frames (F,) that have descriptors of a kind, or none at all.

    Landmarks that lose their last observation are removed.
    """
    removed = []
    for row, blocks in enumerate(vi_map.frames.descriptor_blocks):
        of_frame = blocks or (DescriptorBlock(int(vi_map.frames.keypoint_count[row]), 0),)
        dropped = [bool(frames[row]) and (_is(block, kind) or not block.size) for block in of_frame]
        removed.append(np.repeat(dropped, [block.keypoints for block in of_frame]))
    none: Mask = np.zeros(0, dtype=np.bool_)
    return edits.remove_keypoints(vi_map, np.concatenate([none, *removed]))


def with_features(
    vi_map: VIMap,
    frames: list[int],
    features: list[ExtractedFeatures],
    kind: DescriptorKind,
    sigma_px: float,
) -> VIMap:
    """Append features to frames, after the keypoints that they have.

    Args:
        frames: Frame rows, each once; their keypoints have descriptors.
        features: Features of each.
        kind: Kind of their descriptors.
        sigma_px: Standard deviation of their keypoints.
    """
    counts = np.array([len(part.scores) for part in features], dtype=np.int64)
    owner = np.repeat(np.array(frames, dtype=np.int64), counts)
    new = Keypoints.filled(
        len(owner),
        uv_px=_stack([part.keypoints_px for part in features], np.zeros((0, 2))),
        sigma_px=np.full(len(owner), sigma_px),
        scale=_stack([_diameters(part) for part in features], np.zeros(0)),
        descriptor=_stack(
            [np.ascontiguousarray(part.descriptors).view(np.uint8) for part in features],
            np.zeros((0, kind.size), dtype=np.uint8),
        ),
    )
    both = Keypoints.concatenate([vi_map.keypoints, new])
    order = np.lexsort(
        (np.arange(len(both)), np.concatenate([vi_map.keypoint_frame.astype(np.int64), owner]))
    )
    table = vi_map.frames
    blocks = list(table.descriptor_blocks)
    layout, present = table.descriptor_layout.copy(), table.present.copy()
    added = np.zeros(len(table), dtype=np.int64)
    for row, count in zip(frames, counts.tolist(), strict=True):
        blocks[row] = (
            *(blocks[row] or ()),
            DescriptorBlock(count, kind.size, kind.depth, kind.feature_type),
        )
        layout[row] = DescriptorLayout.BLOCKS
        present[row] |= _FIELDS
        added[row] = count
    return vi_map.replace(
        frames=table.replace(
            keypoint_count=table.keypoint_count + added,
            descriptor_blocks=object_column(blocks),
            descriptor_layout=layout,
            present=present,
        ),
        keypoints=both.take(order),
    )


def keypoints_of(vi_map: VIMap, frames: I64) -> tuple[I64, I64]:
    """Return the keypoint rows of frames, and where those of each begin."""
    counts = vi_map.frames.keypoint_count[frames]
    start = starts_of_counts(counts)
    first = np.repeat(vi_map.keypoint_start[frames] - start[:-1], counts)
    return first + np.arange(int(start[-1])), start


def _stack(parts: list[NDArray[Any]], empty: NDArray[Any]) -> NDArray[Any]:
    return np.concatenate(parts) if parts else empty


def _diameters(features: ExtractedFeatures) -> F64:
    return (
        np.zeros(len(features.scores)) if features.diameters_px is None else features.diameters_px
    )


def _is(block: DescriptorBlock, kind: DescriptorKind) -> bool:
    return (block.size, block.feature_type, block.depth) == (
        kind.size,
        kind.feature_type,
        kind.depth,
    )
