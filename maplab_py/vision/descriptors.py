"""Descriptors of any length: packing of bits into words, Hamming and squared distances."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from maplab_py.array_types import I8, I64, U8, U64


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
