"""Descriptors of any length: packing of bits into words, Hamming and squared distances."""

from typing import Any, NamedTuple

import numpy as np

from maplab_py.array_types import F64, I8, I64, U8, U64, Mask, NDArray
from maplab_py.vimap.descriptors import DescriptorDepth, FeatureType, type_name


def pack_words(descriptors: U8) -> U64:
    """Return descriptors (N, bytes) as words (N, ceil(bytes / 8)), padded with zero bits."""
    count, size = descriptors.shape
    words = -(-size // 8)
    padded = np.zeros((count, words * 8), dtype=np.uint8)
    padded[:, :size] = descriptors
    return padded.view(np.uint64)


def differences(
    words_a: U64 | I8, rows_a: I64, words_b: U64 | I8, rows_b: I64
) -> NDArray[np.int32]:
    """Return the differences (N,) between rows of two tables of descriptors.

    Of packed bits they are Hamming distances [bits], of signed bytes squared Euclidean distances.

    Args:
        words_a: Packed descriptors or signed bytes (A, W).
        rows_a: Rows of `words_a` (N,).
        words_b: Descriptors (B, W) of the same type and length.
        rows_b: Rows of `words_b` (N,).

    Raises:
        ValueError: The descriptors have different lengths.
    """
    if words_a.shape[1] != words_b.shape[1] or words_a.dtype != words_b.dtype:
        sizes = [words.shape[1] * words.itemsize for words in (words_a, words_b)]
        raise ValueError(f"descriptors of {sizes[0]} and {sizes[1]} bytes cannot be compared")
    from maplab_py.vision.search_kernels import differences_between

    distance = np.empty(len(rows_a), dtype=np.int32)
    rows_a, rows_b = np.ascontiguousarray(rows_a), np.ascontiguousarray(rows_b)
    differences_between(words_a, rows_a, words_b, rows_b, distance)
    return distance


def compile_kernels(kind: type[np.uint64 | np.int8] = np.uint64) -> None:
    """Compile the differences of packed bits, or of signed bytes, on one descriptor."""
    words: Any = np.zeros((1, 1), dtype=kind)
    rows = np.zeros(1, dtype=np.int64)
    differences(words, rows, words, rows)


# Kinds of descriptors: which can be compared with each other, and how.
#
# Binary descriptors are compared by the number of different bits. All others are vectors of numbers,
# scaled to unit length, so that Euclidean distance and cosine order them alike; they are compared as
# signed bytes, whose rounding moves a vector of 256 numbers by 0.018, far less than descriptors vary.

_ROWS_AT_ONCE = 16_384
_SPREAD: dict[int, float] = {FeatureType.XFEAT: 4.0 / 3.0}
"""Distance at which descriptors of a type match, relative to SIFT's. Pairs of recorded keyframes: at 0.45
XFeat verifies a third fewer than at 0.6; from 0.7 on some are wrong."""
STEPS_PER_UNIT = 254
"""Steps of a signed byte per unit of length: single numbers up to half the length are kept."""


class Projected(NamedTuple):
    """Descriptors as summary maps hold them: projected to few dimensions."""

    dimensions: int = 10
    spread: float = 1.0  # squared distance of a match, relative to Binary's
    coarseness: float = 1.0  # of the steps to which they are rounded
    spread_of_fewer: float = 1.0  # like `spread`, in fewer dimensions


_PROJECTED: dict[int, Projected] = {FeatureType.XFEAT: Projected(24, 1.25, 8.0, 0.75)}
"""Of 25 images in an eighth of the light (rendered rooms) XFeat localises 22 in a full map. In summary maps 5
with 10 dimensions, 15 with 16, 21 with 24 and 32, and 24 with all 64, which takes four times as long; one is
wrong from a spread of 1.7 on, with 10 dimensions from 1 on, and none at 0.75. Eight times coarser steps are
signed bytes, at no loss."""


class DescriptorKind(NamedTuple):
    """Feature type, size and depth of descriptors; only equal kinds match each other."""

    size: int  # bytes of a descriptor
    feature_type: int = FeatureType.BINARY
    depth: int = DescriptorDepth.UINT8

    @property
    def is_binary(self) -> bool:
        """Return whether descriptors are bit strings."""
        return self.feature_type == FeatureType.BINARY

    @property
    def dimensions(self) -> int:
        """Return the number of bits of a binary descriptor, of numbers of another one."""
        if self.is_binary:
            return 8 * self.size
        return self.size // 4 if self.depth == DescriptorDepth.FLOAT32 else self.size

    @property
    def words(self) -> str:
        """Return the kind in words, as in "SIFT of 128 bytes"."""
        return f"{type_name(self.feature_type)} of {self.size} bytes"

    def steps(self, raw: U8) -> I8:
        """Return descriptors (N, size) that are not binary as vectors of signed bytes (N, dimensions).

        They have unit length, that is `STEPS_PER_UNIT`. Vectors without a length, or with a number
        that is not finite, become zero; see `has_content`.
        """
        steps = np.empty((len(raw), self.dimensions), dtype=np.int8)
        for begin in range(0, len(raw), _ROWS_AT_ONCE):
            rows = slice(begin, begin + _ROWS_AT_ONCE)
            values = np.ascontiguousarray(raw[rows])
            if self.depth == DescriptorDepth.FLOAT32:
                values = values.view("<f4")
            steps[rows] = self._round(values.astype(np.float64))
        return steps

    def _round(self, vectors: F64) -> I8:
        """Return vectors (N, dimensions) of any length as signed bytes of unit length."""
        largest = np.abs(vectors).max(axis=1, initial=0.0, keepdims=True)
        usable = np.isfinite(largest) & (largest > 0.0)  # a NaN makes the largest one NaN
        vectors = np.where(usable, vectors, 0.0) / np.where(usable, largest, 1.0)
        length = np.sqrt(np.einsum("nd,nd->n", vectors, vectors))[:, None]
        vectors *= STEPS_PER_UNIT / np.where(length > 0.0, length, 1.0)
        return np.clip(np.rint(vectors), -127, 127).astype(np.int8)

    def has_content(self, raw: U8) -> Mask:
        """Return which descriptors (N, size) can be compared: binary ones, and vectors with a length."""
        if self.is_binary:
            return np.ones(len(raw), dtype=np.bool_)
        return np.asarray(self.steps(raw).any(axis=1))

    def comparable(self, raw: U8) -> U64 | I8:
        """Return descriptors (N, size) as indices compare them: packed bits, or signed bytes."""
        return pack_words(raw) if self.is_binary else self.steps(raw)

    def largest(self, bit_fraction: float, distance: float) -> float:
        """Return the largest difference of a match in the unit that `differences` counts in.

        Args:
            bit_fraction: Largest share of different bits of binary descriptors.
            distance: Largest Euclidean distance of SIFT descriptors, scaled to unit length; a third more
                is allowed for XFeat.
        """
        if self.is_binary:
            return bit_fraction * 8 * self.size
        return (distance * _SPREAD.get(self.feature_type, 1.0) * STEPS_PER_UNIT) ** 2

    @property
    def projected(self) -> Projected:
        """Return how summary maps hold these descriptors."""
        return _PROJECTED.get(self.feature_type, Projected())

    def largest_projected(self, squared_distance: float, dimensions: int) -> float:
        """Return the largest squared distance of a match of projected descriptors.

        Args:
            squared_distance: That of Binary in 10 dimensions.
            dimensions: Dimensions; the noise grows with them.
        """
        stored = self.projected
        is_fewer = dimensions < stored.dimensions
        spread = stored.spread_of_fewer if is_fewer else stored.spread
        return squared_distance * spread * dimensions / Projected().dimensions
