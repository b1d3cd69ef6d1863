"""Warm-up of the optimiser's kernels: each is compiled before its first use."""

from collections.abc import Callable
from functools import partial

from maplab_py.estimation.codegen.kernels import residual_kernel
from maplab_py.estimation.imu import preintegration
from maplab_py.estimation.linear import block_cholesky
from maplab_py.estimation.problem import iterative
from maplab_py.estimation.symbolic import sources
from maplab_py.estimation.terms import factor, visual

_RESIDUALS = (
    "inertial",
    "inertial_with_intrinsics",
    "relative_pose",
    "relative_pose_with_mounting",
    "scaled_relative_pose",
    "scaled_relative_pose_with_mounting",
    "switched_relative_pose",
    "absolute_pose",
    "absolute_pose_with_mounting",
)
"""Functions of `symbolic.sources`."""


def optimizer_jobs() -> dict[str, Callable[[], None]]:
    """Return functions by name, each of which compiles kernels that are used together."""
    jobs: dict[str, Callable[[], None]] = {
        name: partial(_compile_residual, name) for name in _RESIDUALS
    }
    jobs["losses and normal equations"] = factor.compile_kernels
    jobs["block Cholesky"] = block_cholesky.compile_kernels
    jobs["conjugate gradients"] = iterative.compile_without_images
    jobs["preintegration"] = preintegration.compile_kernels
    jobs["reprojection"] = _compile_reprojection
    return jobs


def _compile_residual(name: str) -> None:
    residual_kernel(name, getattr(sources, name)).compile_kernel()


def _compile_reprojection() -> None:
    visual.compile_kernels()
    iterative.compile_kernels()
