"""Maps whose binary descriptors are exchanged for descriptors of numbers that mean the same."""

import numpy as np
from numpy.typing import NDArray

from maplab_py.vimap import DescriptorBlock, DescriptorDepth, FeatureType, VIMap, table


def as_numbers(
    bits: NDArray[np.uint8], *, dimensions: int = 64, seed: int = 5
) -> NDArray[np.float32]:
    """Return random projections (N, dimensions) of descriptors (N, bytes): distances are kept."""
    signs = 2.0 * np.unpackbits(bits, axis=1) - 1.0
    directions = np.random.default_rng(seed).normal(size=(signs.shape[1], dimensions))
    return np.asarray(signs @ directions, dtype=np.float32)


def with_numbers(
    vi_map: VIMap, feature_type: int = FeatureType.SUPERPOINT, *, scale: float = 1.0
) -> VIMap:
    """Return the map with float32 descriptors of another type in place of its binary ones."""
    size = int(vi_map.binary_descriptor_size.max())
    numbers = scale * as_numbers(vi_map.keypoints.descriptor[:, :size])
    raw = np.ascontiguousarray(numbers, dtype="<f4").view(np.uint8)
    blocks = [
        (DescriptorBlock(count, raw.shape[1], DescriptorDepth.FLOAT32, feature_type),)
        for count in vi_map.frames.keypoint_count.tolist()
    ]
    return vi_map.replace(
        frames=vi_map.frames.replace(descriptor_blocks=table.object_column(blocks)),
        keypoints=vi_map.keypoints.replace(descriptor=raw),
        landmarks=vi_map.landmarks.replace(
            feature_type=np.full(len(vi_map.landmarks), feature_type, dtype=np.int32)
        ),
    )
