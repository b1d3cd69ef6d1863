"""Descriptor projections on disk: one .npz file with the matrix and the number of its tracks."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from maplab_py.errors import UserError
from maplab_py.output_files import check_writable, write_bytes
from maplab_py.vision.projection import DescriptorProjection


def save_projection(
    projection: DescriptorProjection, path: Path, *, overwrite: bool = False
) -> None:
    """Write a projection.

    Raises:
        UserError: The file exists and `overwrite` is not set, or it cannot be written.
    """
    check_writable(path, overwrite=overwrite)
    content = io.BytesIO()
    np.savez(content, matrix=projection.matrix)
    write_bytes(path, [content.getvalue()], overwrite=overwrite)


def load_projection(path: Path) -> DescriptorProjection:
    """Read what `save_projection` has written.

    Raises:
        UserError: The file cannot be read or is no such file.
    """
    try:
        with np.load(path, allow_pickle=False) as content:
            matrix = np.ascontiguousarray(content["matrix"], dtype=np.float32)
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror or error}") from error
    except (ValueError, KeyError, AttributeError):
        raise UserError(f"{path} is not a projection: train_projection_matrix writes one") from None
    if matrix.ndim != 2 or matrix.shape[1] % 8 or not np.isfinite(matrix).all():
        raise UserError(f"{path}: the matrix is not (dimensions, 8 * bytes of a descriptor)")
    return DescriptorProjection(matrix)
