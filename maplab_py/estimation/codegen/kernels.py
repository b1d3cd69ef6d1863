"""The compiled kernels: visual ones per set of camera models, batch ones per residual."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any

from maplab_py.estimation.codegen.modules import generated_module, template_source
from maplab_py.progress import SILENT, Progress
from maplab_py.sensors.camera import (
    DISTORTION_SIZE,
    INTRINSICS_SIZE,
    Distortion,
    Projection,
)

CameraModel = tuple[Projection, Distortion]

_HEADER = (
    '"""Generated; do not edit."""\n\n'
    "import math\n\nimport numpy as np\nfrom numba import njit, prange\n\n"
)
_FAST = '@njit(cache=True, error_model="numpy", fastmath={"contract", "nsz"}, forceinline=True)\n'


def visual_kernels(models: tuple[CameraModel, ...], progress: Progress = SILENT) -> ModuleType:
    """Return the module with `eliminate`, `substitute` and `evaluate` for these camera models.

    The row of a camera's `parameters` begins with the index of its model in `models`.
    """
    names = [f"{p.name.lower()}_{d.name.lower()}" for p, d in models]
    return generated_module("visual_" + "__".join(names), lambda: _visual_source(models), progress)


def calibrating_kernels(models: tuple[CameraModel, ...], progress: Progress = SILENT) -> ModuleType:
    """Return the module of the same functions for cameras whose calibration is estimated too."""
    names = [f"{p.name.lower()}_{d.name.lower()}" for p, d in models]
    name = "calibrating_" + "__".join(names)
    return generated_module(name, lambda: _calibrating_source(models), progress)


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


_REPROJECTION = "poses, k, extrinsics, c, parameters, points, l, uv, o, out"


def _visual_source(models: tuple[CameraModel, ...]) -> str:
    from maplab_py.estimation.codegen.lowering import entries
    from maplab_py.estimation.symbolic.residuals import reprojection

    result, depth = entries("out"), entries("out", 2)
    parts = [_HEADER, "NUM_OUT = 21\n\n\n"]
    for suffix, jacobian in (("", entries("out", 3)), ("_only", None)):
        for index, model in enumerate(models):
            name, function = f"reproject{suffix}_{index}", reprojection(*model)
            parts.append(_reprojection(name, function, [result, depth, jacobian]))
        parts.append(_dispatcher(f"reproject{suffix}", _REPROJECTION, len(models)))
    return "".join([*parts, template_source("visual_common"), "\n\n", template_source("visual")])


def _calibrating_source(models: tuple[CameraModel, ...]) -> str:
    from maplab_py.estimation.codegen.lowering import entries
    from maplab_py.estimation.symbolic.residuals import calibrating_reprojection

    result, depth = entries("out"), entries("out", 2)
    widest = max(INTRINSICS_SIZE[p] + DISTORTION_SIZE[d] for p, d in models)
    columns = camera_columns(widest)
    first, end = 21 + 2 * CAMERA_INTRINSICS_COLUMN, 21 + 2 * columns
    parts = [_HEADER, f"NUM_OUT = {end}\nCAMERA_COLUMNS = {columns}\n\n\n"]
    for index, (projection, distortion) in enumerate(models):
        function = calibrating_reprojection(projection, distortion)
        by_camera = [entries("out", 3), entries("out", 21), entries("out", first)]
        used = first + 2 * (INTRINSICS_SIZE[projection] + DISTORTION_SIZE[distortion])
        padding = [*range(21 + 12, first), *range(used, end)]
        places = [result, depth, *by_camera]
        parts.append(_reprojection(f"reproject_{index}", function, places, zero=padding))
        parts.append(
            _reprojection(f"reproject_only_{index}", function, [result, depth, None, None, None])
        )
    names = ("reproject", "reproject_only")
    parts += [_dispatcher(name, _REPROJECTION, len(models)) for name in names]
    templates = ("visual_common", "visual", "visual_calibration")
    return "".join(parts) + "\n\n".join(template_source(name) for name in templates)


CAMERA_INTRINSICS_COLUMN = 9
"""Columns of a camera: position 3, orientation 3, time offset 1 and 2 of padding, then this."""


def camera_columns(num_parameters: int) -> int:
    """Return the columns of a camera with so many intrinsic parameters, whole nodes of three."""
    return CAMERA_INTRINSICS_COLUMN + 3 * -(-num_parameters // 3)


def _reprojection(name: str, function: Any, outputs: list[Any], zero: Sequence[int] = ()) -> str:
    from maplab_py.estimation.codegen.lowering import function_body, row_entries

    inputs = [
        row_entries("poses", "k"),
        row_entries("extrinsics", "c"),
        row_entries("parameters", "c", offset=1),
        row_entries("points", "l"),
        row_entries("uv", "o"),
    ]
    lines = function_body(function, inputs, outputs)
    return _function(name, _REPROJECTION, [*lines, *(f"out[{k}] = 0.0" for k in zero)])


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
