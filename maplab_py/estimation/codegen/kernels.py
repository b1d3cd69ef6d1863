"""The compiled kernels: visual ones per set of camera models, batch ones per residual."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any

from maplab_py.estimation.codegen.modules import generated_module, template_source
from maplab_py.estimation.symbolic.sources import PoseError
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
    "import math\n\nimport numpy as np\nfrom maplab_py.compilation import njit, prange\n\n"
    "from maplab_py.estimation.kernels.loss import rho_and_weight\n\n"
)
_FAST = '@njit(cache=True, error_model="numpy", fastmath={"contract", "nsz"}, forceinline=True)\n'


def visual_kernels(
    models: tuple[CameraModel, ...],
    progress: Progress = SILENT,
    *,
    calibrating: bool = False,
    line_delays: bool = False,
) -> ModuleType:
    """Return the module with `eliminate`, `substitute` and `evaluate` for these camera models.

    Where cameras are not estimated it has `keep_jacobians` too. The row of a camera's `parameters`
    begins with the index of its model in `models`.

    Args:
        models: The models of the cameras.
        progress: Told when something has to be compiled.
        calibrating: Whether the cameras' calibration is estimated too (CAMERA_COLUMNS > 0).
        line_delays: Whether it includes the time between two rows of a rolling shutter.
    """
    return generated_module(
        visual_module_name(models, calibrating=calibrating, line_delays=line_delays),
        lambda: _visual_source(models, calibrating=calibrating, line_delays=line_delays),
        progress,
    )


def visual_module_name(
    models: tuple[CameraModel, ...], *, calibrating: bool = False, line_delays: bool = False
) -> str:
    """Return the name of the module that `visual_kernels` returns."""
    name = "__".join(f"{p.name.lower()}_{d.name.lower()}" for p, d in models)
    if line_delays:
        return f"calibrating_rows_{name}"
    return f"{'calibrating' if calibrating else 'visual'}_{name}"


def window_kernels(models: tuple[CameraModel, ...], progress: Progress = SILENT) -> ModuleType:
    """Return the module of the template `window` for these camera models, as `visual_kernels`."""
    name = "__".join(f"{p.name.lower()}_{d.name.lower()}" for p, d in models)
    return generated_module(f"window_{name}", lambda: _window_source(models), progress)


def residual_kernel(
    name: str, make_function: Callable[[], Any], progress: Progress = SILENT
) -> ModuleType:
    """Return the module with `evaluated` and `compile_kernel` of a residual function.

    Args:
        name: Name of the residual, unique among all kernels.
        make_function: Makes the casadi function (inputs...) -> residual (m), Jacobian (m, D).
        progress: Told when something has to be compiled.
    """
    return generated_module(name, lambda: _batch_source(make_function()), progress)


def pose_graph_kernels(error: PoseError, progress: Progress = SILENT) -> ModuleType:
    """Return the module of the template `pose_graph` for one kind of residual."""
    return generated_module(
        f"pose_graph_{error.value}", lambda: _pose_graph_source(error), progress
    )


_REPROJECTION = "poses, k, extrinsics, c, parameters, points, l, uv, o, out"


_POSE, _LANDMARK, _CAMERA = 3, 15, 21
"""Where the Jacobian's columns begin in `out`, after residual (2) and depth; two entries a column."""


def _visual_source(
    models: tuple[CameraModel, ...], *, calibrating: bool, line_delays: bool = False
) -> str:
    from maplab_py.estimation.codegen.lowering import entries
    from maplab_py.estimation.symbolic.residuals import reprojection

    widest = max(INTRINSICS_SIZE[p] + DISTORTION_SIZE[d] for p, d in models)
    calibrating = calibrating or line_delays
    columns = camera_columns(widest) if calibrating else 0
    end = _CAMERA + 2 * columns
    time_offset = _CAMERA + 2 * CAMERA_TIME_OFFSET_COLUMN
    intrinsics = _CAMERA + 2 * CAMERA_INTRINSICS_COLUMN
    parts = [
        _HEADER,
        f"POSE, LANDMARK, CAMERA, TIME_OFFSET = {_POSE}, {_LANDMARK}, {_CAMERA}, {time_offset}\n"
        f"CAMERA_COLUMNS, NUM_OUT = {columns}, {end}\n\n\n",
    ]
    for index, (projection, distortion) in enumerate(models):
        function = reprojection(projection, distortion)
        places = [entries("out"), entries("out", 2), entries("out", _POSE), None, None]
        padding: list[int] = []
        if calibrating:
            places[3:] = entries("out", _CAMERA), entries("out", intrinsics)
            used = intrinsics + 2 * (INTRINSICS_SIZE[projection] + DISTORTION_SIZE[distortion])
            padding = [*range(time_offset, intrinsics), *range(used, end)]
        parts.append(_reprojection(f"reproject_{index}", function, places, zero=padding))
        only = [*places[:2], None, None, None]
        parts.append(_reprojection(f"reproject_only_{index}", function, only))
    names = ("reproject", "reproject_only")
    parts += [_dispatcher(name, _REPROJECTION, len(models)) for name in names]
    templates = ["visual_common", "visual", *(() if calibrating else ("visual_jacobians",))]
    if line_delays:
        templates.append("visual_rows")
    return "".join(parts) + "\n\n".join(template_source(name) for name in templates)


CAMERA_TIME_OFFSET_COLUMN = 6
CAMERA_INTRINSICS_COLUMN = 9
"""Columns of a camera: position 3, orientation 3, image delay, line delay, 1 of padding, then this."""


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


_ANCHORED = "poses, a, k, extrinsics, d, c, parameters, h, l, uv, o, out"


def _window_source(models: tuple[CameraModel, ...]) -> str:
    from maplab_py.estimation.codegen.lowering import entries, function_body, row_entries
    from maplab_py.estimation.symbolic.residuals import anchored_reprojection

    inputs = [
        row_entries("poses", "a"),
        row_entries("extrinsics", "d"),
        row_entries("poses", "k"),
        row_entries("extrinsics", "c"),
        row_entries("parameters", "c", offset=1),
        row_entries("h", "l"),
        row_entries("uv", "o"),
    ]
    anchor, landmark, end = _POSE + 12, _POSE + 24, _POSE + 30
    sizes = f"POSE, ANCHOR, LANDMARK, NUM_OUT = {_POSE}, {anchor}, {landmark}, {end}\n\n\n"
    parts = [_HEADER, sizes]
    places = [entries("out"), entries("out", 2), entries("out", anchor), entries("out", _POSE)]
    for index, model in enumerate(models):
        function = anchored_reprojection(*model)
        lines = function_body(function, inputs, [*places, entries("out", landmark)])
        parts.append(_function(f"reproject_{index}", _ANCHORED, lines))
        lines = function_body(function, inputs, [*places[:2], None, None, None])
        parts.append(_function(f"reproject_only_{index}", _ANCHORED, lines))
    names = ("reproject", "reproject_only")
    parts += [_dispatcher(name, _ANCHORED, len(models)) for name in names]
    return "".join(parts) + "\n\n".join(template_source(n) for n in ("visual_common", "window"))


def _batch_source(function: Any) -> str:
    from maplab_py.estimation.codegen.lowering import entries, function_body

    offsets, total = [], 0
    for i in range(function.n_in()):
        offsets.append(total)
        total += function.numel_in(i)
    inputs = [entries("x", offset) for offset in offsets]
    lines = function_body(function, inputs, [entries("r"), entries("J")])
    rows = function.numel_out(0)
    sizes = f"INPUTS, ROWS, COLUMNS = {total}, {rows}, {function.numel_out(1) // rows}\n\n\n"
    return _HEADER + sizes + _function("residual", "x, r, J", lines) + template_source("batch")


def _pose_graph_source(kind: PoseError) -> str:
    from maplab_py.estimation.codegen.lowering import entries, function_body
    from maplab_py.estimation.symbolic import pose_graph

    error = {
        PoseError.SPLIT: pose_graph.split_error,
        PoseError.LOGARITHM: pose_graph.logarithmic_error,
    }[kind]
    functions: list[tuple[str, Any, str, list[str | None]]] = [
        ("error", pose_graph.linearised(error), "A, B, measured", ["e", None, None]),
        ("linearised", pose_graph.linearised(error), "A, B, measured", ["e", "J_A", "J_B"]),
        ("second", pose_graph.second_derivatives(error), "A, B, measured, g", ["AA", "BB", "BA"]),
        ("tilt", pose_graph.tilt(), "T, measured", ["e", "J"]),
        ("retraction", pose_graph.retraction(), "T, x", ["moved"]),
    ]
    parts = [_HEADER, "from maplab_py.estimation.kernels.loss import rho_and_weight\n\n\n"]
    for name, function, inputs, outputs in functions:
        places = [None if output is None else entries(output) for output in outputs]
        lines = function_body(function, [entries(x) for x in inputs.split(", ")], places)
        arguments = ", ".join([inputs, *(output for output in outputs if output is not None)])
        parts.append(_function(name, arguments, lines))
    return "".join([*parts, template_source("pose_graph")])


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
