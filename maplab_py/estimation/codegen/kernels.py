"""The compiled kernels: visual ones per set of camera models, batch ones per residual."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any

from maplab_py.estimation.codegen.modules import generated_module, template_source
from maplab_py.progress import SILENT, Progress
from maplab_py.sensors.camera import Distortion, Projection

CameraModel = tuple[Projection, Distortion]

_HEADER = (
    '"""Generated; do not edit."""\n\n'
    "import math\n\nimport numpy as np\nfrom numba import njit, prange\n\n"
)
_FAST = '@njit(cache=True, error_model="numpy", fastmath={"contract", "nsz"})\n'


def visual_kernels(models: tuple[CameraModel, ...], progress: Progress = SILENT) -> ModuleType:
    """Return the module with `eliminate`, `substitute` and `evaluate` for these camera models.

    The row of a camera's `parameters` begins with the index of its model in `models`.
    """
    names = [f"{p.name.lower()}_{d.name.lower()}" for p, d in models]
    return generated_module("visual_" + "__".join(names), lambda: _visual_source(models), progress)


def residual_kernel(
    name: str, make_function: Callable[[], Any], progress: Progress = SILENT
) -> ModuleType:
    """Return the module with the batch `evaluate` of a residual function.

    Args:
        name: Name of the residual, unique among all kernels.
        make_function: Makes the casadi function (inputs...) -> residual (m), Jacobian (m, D).
        progress: Told when something has to be compiled.
    """
    return generated_module(name, lambda: _batch_source(make_function()), progress)


def _visual_source(models: tuple[CameraModel, ...]) -> str:
    from maplab_py.estimation.codegen.lowering import entries, function_body, row_entries
    from maplab_py.estimation.symbolic.residuals import reprojection

    arguments = "poses, k, extrinsics, c, parameters, points, l, uv, o, out"
    inputs = [
        row_entries("poses", "k"),
        row_entries("extrinsics", "c"),
        row_entries("parameters", "c", offset=1),
        row_entries("points", "l"),
        row_entries("uv", "o"),
    ]
    parts = [_HEADER]
    for suffix, jacobian in (("", entries("out", 3)), ("_only", None)):
        for index, model in enumerate(models):
            lines = function_body(
                reprojection(*model), inputs, [entries("out"), entries("out", 2), jacobian]
            )
            parts.append(_function(f"reproject{suffix}_{index}", arguments, lines))
        parts.append(_dispatcher(f"reproject{suffix}", arguments, len(models)))
    return "".join([*parts, template_source("visual")])


def _batch_source(function: Any) -> str:
    from maplab_py.estimation.codegen.lowering import entries, function_body

    offsets, total = [], 0
    for i in range(function.n_in()):
        offsets.append(total)
        total += function.numel_in(i)
    inputs = [entries("x", offset) for offset in offsets]
    lines = function_body(function, inputs, [entries("r"), entries("J")])
    return _HEADER + _function("residual", "x, r, J", lines) + template_source("batch")


def _function(name: str, arguments: str, lines: list[str]) -> str:
    return _FAST + f"def {name}({arguments}):\n    " + "\n    ".join(lines) + "\n\n\n"


def _dispatcher(name: str, arguments: str, count: int) -> str:
    if count == 1:
        return _function(name, arguments, [f"{name}_0({arguments})"])
    lines = []
    for index in range(count):
        lines.append(f"{'if' if index == 0 else 'elif'} parameters[c, 0] == {index}.0:")
        lines.append(f"    {name}_{index}({arguments})")
    return _function(name, arguments, lines)
