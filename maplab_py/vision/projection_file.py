"""Descriptor projections on disk: one .npz file with the matrix and the number of its tracks."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from maplab_py.array_types import F32
from maplab_py.errors import UserError
from maplab_py.input_files import read_npz
from maplab_py.output_files import check_writable, write_bytes
from maplab_py.vision.descriptor_kind import DescriptorKind
from maplab_py.vision.projection import DescriptorProjection

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
