"""The kernels of dense maps, compiled before they are needed."""

from __future__ import annotations

from maplab_py.algorithms.dense.distance import triangle_kernels
from maplab_py.algorithms.dense.fusion import (
    block_kernels,
    integration_kernels,
    surface_kernels,
)
from maplab_py.algorithms.dense.stereo import agreement_kernels


def compile_dense() -> None:
    """Compile the kernels of stereo, fusion and distances."""
    for module in (
        agreement_kernels,
        block_kernels,
        integration_kernels,
        surface_kernels,
        triangle_kernels,
    ):
        module.compile_kernels()
