"""Descriptor blocks of a frame: consecutive keypoints of one feature type and size."""

from collections.abc import Callable
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maplab_py.array_types import I32
from maplab_py.errors import FlagError
from maplab_py.vimap.table import object_column
from maplab_py.vimap.tables import Frames

NO_DESCRIPTOR = -1
"""Feature type of a keypoint that has no descriptor."""


class FeatureType(IntEnum):
    """Kinds of features: proto values of maplab, and XFEAT, which it reads as a type without a name."""

    BINARY = 0
    SUPERPOINT = 1
    R2D2 = 2
    SIFT = 3
    LIDAR_SUPERPOINT = 21
    XFEAT = 40


class DescriptorDepth(IntEnum):
    """Type of the numbers of a descriptor (OpenCV's values)."""

    UINT8 = 0
    FLOAT32 = 5


class DescriptorBlock(NamedTuple):
    """Consecutive keypoints of a frame whose descriptors have the same type and size."""

    keypoints: int
    size: int  # bytes per descriptor
    depth: int = DescriptorDepth.UINT8
    feature_type: int = FeatureType.BINARY

    @property
    def is_binary(self) -> bool:
        """Return whether the descriptors are bit strings."""
        return (
            self.feature_type == FeatureType.BINARY
            and self.depth == DescriptorDepth.UINT8
            and self.size > 0
        )


def binary_blocks(keypoint_count: ArrayLike, size: ArrayLike) -> NDArray[Any]:
    """Return the column `Frames.descriptor_blocks` of frames with binary descriptors only.

    Args:
        keypoint_count: Keypoints of each frame (F,).
        size: Bytes per descriptor, of all frames or of each (F,); 0 = the frame has none.
    """
    counts = np.asarray(keypoint_count, dtype=np.int64)
    sizes = np.broadcast_to(np.asarray(size, dtype=np.int64), counts.shape)
    return object_column(
        [
            (DescriptorBlock(count, width),) if width else None
            for count, width in zip(counts.tolist(), sizes.tolist(), strict=True)
        ]
    )


def no_blocks(frames: int) -> NDArray[Any]:
    """Return the column `Frames.descriptor_blocks` of frames without descriptors."""
    return object_column([None] * frames)


def binary_descriptor_sizes(frames: Frames) -> I32:
    """Return the bytes (K,) of each keypoint's binary descriptor, 0 where it has none."""
    return _of_keypoints(frames, lambda block: block.size if block.is_binary else 0, 0)


def sizes_of_type(frames: Frames, feature_type: int, depth: int) -> I32:
    """Return the bytes (K,) of each keypoint's descriptor of a type and depth, 0 of all others."""

    def size(block: DescriptorBlock) -> int:
        return block.size if block[2:] == (depth, feature_type) else 0

    return _of_keypoints(frames, size, 0)


def feature_types(frames: Frames) -> I32:
    """Return the feature type (K,) of each keypoint's descriptor, `NO_DESCRIPTOR` without one."""
    return _of_keypoints(frames, lambda block: block.feature_type, NO_DESCRIPTOR)


def types_of(frames: Frames) -> set[int]:
    """Return the feature types of all descriptors that can be compared.

    Descriptors of the binary type with numbers that are not bytes cannot be.
    """
    return {
        block.feature_type
        for blocks in frames.descriptor_blocks
        for block in blocks or ()
        if block.keypoints and (block.is_binary or block.feature_type != FeatureType.BINARY)
    }


def type_name(feature_type: int) -> str:
    """Return maplab's name of a feature type, as in "SIFT" or "type 7"."""
    return _NAMES.get(feature_type, f"type {feature_type}")


def type_of_name(name: str, flag: str = "") -> int:
    """Return the feature type that maplab calls so; its number is a name, too.

    Raises:
        FlagError: There is no such type; the message names the flag, if one is given.
    """
    for feature_type, known in _NAMES.items():
        if name.lower() == known.lower():
            return feature_type
    if name.isdigit() and int(name) < 2**31:
        return int(name)
    said = f"{name} is no feature type: wants one of {', '.join(TYPE_NAMES)}, or a number"
    raise FlagError(f"--{flag}: {said}" if flag else said)


_NAMES: dict[int, str] = {
    FeatureType.BINARY: "Binary",
    FeatureType.SUPERPOINT: "SuperPoint",
    FeatureType.R2D2: "R2D2",
    FeatureType.SIFT: "SIFT",
    FeatureType.LIDAR_SUPERPOINT: "LIDARSuperPoint",
    FeatureType.XFEAT: "XFeat",
}
TYPE_NAMES = tuple(_NAMES.values())
"""Names of the feature types in maplab's flags."""


def _of_keypoints(frames: Frames, value: Callable[[DescriptorBlock], int], default: int) -> I32:
    """Return a number (K,) of each keypoint's block."""
    values, counts = [], []
    for blocks, count in zip(frames.descriptor_blocks, frames.keypoint_count.tolist(), strict=True):
        for block in blocks or ():
            values.append(value(block))
            counts.append(block.keypoints)
        if not blocks:
            values.append(default)
            counts.append(count)
    if sum(counts) != int(frames.keypoint_count.sum()):
        raise ValueError("the descriptor blocks of the frames do not fit their keypoints")
    return np.repeat(np.array(values, dtype=np.int32), np.array(counts, dtype=np.int64))
