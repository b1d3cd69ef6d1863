"""Projection of descriptors to few real dimensions, learned from tracks.

Within a track descriptors vary by noise; between tracks they vary by content. The projection
keeps the directions along which the two differ most, scaled so that the squared Euclidean
distance is (up to a constant) the log likelihood ratio of "different" against "same".
Source: Lynen 2015, section IV; Bosse and Zlot 2013.
"""

import dataclasses
import io
from functools import cached_property
from pathlib import Path

import numpy as np

from maplab_py.array_types import F32, F64, I64, U8, mask_of
from maplab_py.compilation import compiled, prange
from maplab_py.errors import EstimationError, UserError
from maplab_py.input_files import read_npz
from maplab_py.output_files import check_writable, write_bytes
from maplab_py.vision.descriptors import DescriptorKind, Projected

DIMENSIONS = Projected().dimensions
MIN_TRACK_LENGTH = 5
MAX_TRAINING_SAMPLES = 50_000
_MIN_TRAINING_TRACKS = 50
_REGULARISATION = 1e-3
"""Variance [bit^2] added to every direction, so that constant bits do not dominate."""
_ROUNDING_VARIANCE = 1.0 / 12.0
"""The same for the signed bytes of other descriptors, which are rounded."""


@dataclasses.dataclass(frozen=True, eq=False)
class DescriptorProjection:
    """Linear map from the bits of a descriptor (most significant bit of byte 0 first), or its numbers.

    Numbers are those of `DescriptorKind.steps`.
    """

    matrix: F32  # (dimensions, 8 * bytes), or (dimensions, numbers)
    given_kind: DescriptorKind | None = None  # None = binary of as many bytes as the matrix takes

    @property
    def kind(self) -> DescriptorKind:
        """The descriptors that this projection takes."""
        return self.given_kind or DescriptorKind(int(self.matrix.shape[1]) // 8)

    @property
    def descriptor_size(self) -> int:
        """Length [bytes] of the descriptors that this projection takes."""
        return self.kind.size

    def project(self, descriptors: U8) -> F32:
        """Return descriptors (N, bytes) as points (N, dimensions).

        Raises:
            EstimationError: The projection was made for descriptors of another length.
        """
        if descriptors.shape[1] != self.descriptor_size:
            raise EstimationError(
                f"the projection takes descriptors of {self.descriptor_size} bytes, not "
                f"{descriptors.shape[1]}"
            )
        projected = np.empty((len(descriptors), len(self.matrix)), dtype=np.float32)
        values = descriptors if self.kind.is_binary else self.kind.steps(descriptors).view(np.uint8)
        _sum_table(np.ascontiguousarray(values), self._table, projected)
        return projected

    @cached_property
    def _table(self) -> F32:
        """Look-up table (bytes, 256, dimensions): contribution of each value of each byte."""
        if not self.kind.is_binary:
            steps = np.arange(256, dtype=np.uint8).view(np.int8).astype(np.float32)
            return steps[:, None] * np.ascontiguousarray(self.matrix.T)[:, None, :]
        values = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1).astype(np.float32)
        by_byte = self.matrix.T.reshape(self.descriptor_size, 8, len(self.matrix))
        table = np.einsum("vb,pbd->pvd", values, by_byte, optimize=False)
        return np.asarray(table, dtype=np.float32)


def learn_projection(
    descriptors: U8,
    track: I64,
    *,
    kind: DescriptorKind | None = None,
    dimensions: int = DIMENSIONS,
) -> DescriptorProjection:
    """Learn the projection from descriptors whose tracks are known. Deterministic.

    Args:
        descriptors: Descriptors (N, bytes).
        track: Label (N,) of the track or landmark that each belongs to, negative for none.
        kind: What the descriptors are; None = binary.
        dimensions: Dimensions to keep.

    Raises:
        EstimationError: Too few tracks.
    """
    rows = _training_rows(track)
    if len(rows) == 0:
        raise EstimationError(
            f"the descriptor projection cannot be learned: fewer than {_MIN_TRAINING_TRACKS} tracks "
            "have two or more observations with descriptors"
        )
    kind = kind or DescriptorKind(descriptors.shape[1])
    raw = descriptors[rows]
    bits = (np.unpackbits(raw, axis=1) if kind.is_binary else kind.steps(raw)).astype(np.float64)
    first = np.flatnonzero(np.diff(track[rows], prepend=-1))
    length = np.diff(np.append(first, len(rows)))
    sums = np.add.reduceat(bits, first, axis=0)
    # sums of products of small integers are exact in double precision, whatever their order
    second_moment = bits.T @ bits
    weighted = sums / np.sqrt(length)[:, None]
    within = (second_moment - weighted.T @ weighted) / (len(rows) - len(first))
    mean = bits.mean(axis=0)
    overall = second_moment / len(rows) - np.outer(mean, mean)
    floor = _REGULARISATION if kind.is_binary else _ROUNDING_VARIANCE
    return DescriptorProjection(_likelihood_ratio_metric(within, overall, dimensions, floor), kind)


def _likelihood_ratio_metric(within: F64, overall: F64, dimensions: int, floor: float) -> F32:
    """Return A (dimensions, bits) with |A d|^2 = d^T (within^-1 - overall^-1) d, truncated."""
    from threadpoolctl import threadpool_limits

    eye = np.eye(len(within)) * floor
    with threadpool_limits(limits=1, user_api="blas"):
        s, V = np.linalg.eigh(within + eye)
        whiten = (V / np.sqrt(s)).T
        D, U = np.linalg.eigh(whiten @ (overall + eye) @ whiten.T)
        best = np.argsort(-D, kind="stable")[:dimensions]
        ratio = np.sqrt(np.maximum(1.0 - 1.0 / D[best], 0.0))
        A = ratio[:, None] * (U[:, best].T @ whiten)
    # the sign of eigenvectors is arbitrary
    A *= np.sign(A[np.arange(len(A)), np.argmax(np.abs(A), axis=1)])[:, None]
    return np.ascontiguousarray(A, dtype=np.float32)


def _training_rows(track: I64) -> I64:
    """Return rows of long enough tracks, track by track; empty when there are too few tracks."""
    order = np.argsort(track, kind="stable")
    order = order[track[order] >= 0]
    labels, index, length = np.unique(track[order], return_inverse=True, return_counts=True)
    min_length = MIN_TRACK_LENGTH
    while min_length >= 2:
        tracks = np.flatnonzero(length >= min_length)
        if len(tracks) >= _MIN_TRAINING_TRACKS or min_length == 2:
            break
        min_length = max(min_length // 2, 2)
    if len(tracks) < _MIN_TRAINING_TRACKS:
        return np.zeros(0, dtype=np.int64)
    step = max(int(np.ceil(length[tracks].sum() / MAX_TRAINING_SAMPLES)), 1)
    taken = mask_of(len(labels), tracks[::step])
    return np.asarray(order[taken[index]], dtype=np.int64)


@compiled(parallel=True)
def _sum_table(descriptors, table, projected):  # type: ignore[no-untyped-def]
    count, size = descriptors.shape
    dimensions = projected.shape[1]
    for i in prange(count):
        for d in range(dimensions):
            projected[i, d] = 0.0
        for p in range(size):
            value = descriptors[i, p]
            for d in range(dimensions):
                projected[i, d] += table[p, value, d]


# Descriptor projections on disk: one .npz file with the matrix and the number of its tracks.

_MAX_BYTES = 64_000_000
"""Maximum size: a thousand dimensions of descriptors of 2000 bytes."""


def save_projection(
    projection: DescriptorProjection, path: Path, *, overwrite: bool = False
) -> None:
    """Write a projection.

    Raises:
        UserError: The file exists and `overwrite` is not set, or it cannot be written.
    """
    check_writable(path, overwrite=overwrite)
    content = io.BytesIO()
    np.savez(content, matrix=projection.matrix, kind=np.array(projection.kind))
    write_bytes(path, [content.getvalue()], overwrite=overwrite)


def load_projection(path: Path) -> DescriptorProjection:
    """Read a projection written by `save_projection`.

    Raises:
        UserError: The file cannot be read, is too large, or is not a projection file.
    """
    try:
        content = read_npz(path, _MAX_BYTES)
        matrix = np.ascontiguousarray(content["matrix"], dtype=np.float32)
        numbers = [int(number) for number in content["kind"]] if "kind" in content else []
        kind = DescriptorKind(*numbers) if numbers else None
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror or error}") from error
    except (ValueError, KeyError, TypeError):
        raise UserError(f"{path} is not a projection: train_projection_matrix writes one") from None
    if matrix.ndim != 2 or not np.isfinite(matrix).all() or not _fits(matrix, kind):
        raise UserError(
            f"{path}: the matrix is not (dimensions, 8 * bytes of a descriptor), or (dimensions, "
            "numbers) of descriptors that are not binary"
        )
    return DescriptorProjection(matrix, kind)


def _fits(matrix: F32, kind: DescriptorKind | None) -> bool:
    """Return whether a matrix takes descriptors of a kind, None = binary of any size."""
    width = int(matrix.shape[1])
    return bool(width % 8 == 0 if kind is None else width == kind.dimensions)
