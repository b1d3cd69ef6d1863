"""Binary descriptors of any length: packing into words and Hamming distances."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maplab_py.array_types import I64, U8, U64


def pack_words(descriptors: U8) -> U64:
    """Return descriptors (N, bytes) as words (N, ceil(bytes / 8)), padded with zero bits."""
    count, size = descriptors.shape
    words = -(-size // 8)
    padded = np.zeros((count, words * 8), dtype=np.uint8)
    padded[:, :size] = descriptors
    return padded.view(np.uint64)


def hamming(words_a: U64, rows_a: I64, words_b: U64, rows_b: I64) -> NDArray[np.int32]:
    """Return the Hamming distances (N,) [bits] between rows of two tables of packed descriptors.

    Args:
        words_a: Packed descriptors (A, W).
        rows_a: Rows of `words_a` (N,).
        words_b: Packed descriptors (B, W) of the same length.
        rows_b: Rows of `words_b` (N,).

    Raises:
        ValueError: The descriptors have different lengths.
    """
    if words_a.shape[1] != words_b.shape[1]:
        raise ValueError(
            f"descriptors of {8 * words_a.shape[1]} and {8 * words_b.shape[1]} bytes cannot be compared"
        )
    from maplab_py.vision.search_kernels import bits_between

    distance = np.empty(len(rows_a), dtype=np.int32)
    bits_between(words_a, rows_a, words_b, rows_b, distance)
    return distance


def compile_kernels() -> None:
    """Compile Hamming distances on one descriptor."""
    words, rows = np.zeros((1, 1), dtype=np.uint64), np.zeros(1, dtype=np.int64)
    hamming(words, rows, words, rows)
