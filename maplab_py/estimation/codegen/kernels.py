"""The compiled kernels: visual ones for all cameras, batch ones per residual."""

from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any

from maplab_py.estimation.codegen.modules import generated_module, template_source
from maplab_py.estimation.symbolic.sources import PoseError
from maplab_py.progress import SILENT, Progress
from maplab_py.sensors.camera import DISTORTION_SIZE, MIRROR_NAMES, Distortion, Projection

_HEADER = (
    '"""Generated; do not edit."""\n\n'
    "import math\n\nimport numpy as np\nfrom maplab_py.compilation import compiled, prange\n\n"
    "from maplab_py.estimation.codegen.straight_line import row, rows_of_six, straight_line\n"
    "from maplab_py.estimation.kernels.loss import rho_and_weight\n\n"
)
_FAST = '@compiled(fastmath={"contract", "nsz"}, forceinline=True)\n'


def visual_kernels(progress: Progress = SILENT) -> ModuleType:
    """Return the module with `eliminate`, `substitute`, `evaluate` and `keep_jacobians`.

    A row of cameras' `parameters` begins with the model's code (`model_code`).
    """
    return generated_module("visual", _visual_source, progress)


def window_kernels() -> ModuleType:
    """Return the module of the template `window`, with cameras as `visual_kernels` has them."""
    return generated_module("window", _window_source, SILENT)


def model_code(projection: Projection, distortion: Distortion) -> int:
    """Return the number by which kernels know a camera model."""
    return (list(Projection).index(projection) << 3) + list(Distortion).index(distortion)


def residual_kernel(
    name: str, make_function: Callable[[], Any], progress: Progress = SILENT
) -> ModuleType:
    """Return the module with `evaluated` and `compile_kernel` of a residual function.

    Args:
        name: Name of the residual, unique among all kernels.
        make_function: Makes the casadi function (inputs...) -> residual (m), Jacobian (m, D).
    """
    return generated_module(name, lambda: _batch_source(make_function()), progress)


def pose_graph_kernels(error: PoseError) -> ModuleType:
    """Return the module of the template `pose_graph` for one kind of residual."""
    name = f"pose_graph_{error.value}"
    return generated_module(name, lambda: _pose_graph_source(error), SILENT)


_POSE, _LANDMARK, _CAMERA = 3, 15, 21
"""Beginnings of the Jacobian's columns in `out`, after residual (2) and depth; two entries a column."""
CAMERA_DELAY_COLUMN = 6
CAMERA_INTRINSICS_COLUMN = 9
"""Columns of a camera: position 3, orientation 3, image delay, line delay, 1 of padding, then this."""


def camera_columns(num_parameters: int) -> int:
    """Return the columns of a camera with so many intrinsic parameters, whole nodes of three."""
    return CAMERA_INTRINSICS_COLUMN + 3 * -(-num_parameters // 3)


def _visual_source() -> str:
    delay, intrinsics = (2 * k for k in (CAMERA_DELAY_COLUMN, CAMERA_INTRINSICS_COLUMN))
    places = (
        f"POSE, LANDMARK, CAMERA, NUM_OUT = {_POSE}, {_LANDMARK}, {_CAMERA}, {_CAMERA}\n"
        f"DELAY, INTRINSICS = CAMERA + {delay}, CAMERA + {intrinsics}\n\n\n"
    )
    names = ("camera", "visual_common", "visual", "visual_step", "visual_jacobians")
    return "\n\n".join([_HEADER + places + _camera_source(), *map(template_source, names)])


def _window_source() -> str:
    anchor, landmark, end = _POSE + 12, _POSE + 24, _POSE + 30
    places = (
        f"POSE, ANCHOR, LANDMARK, NUM_OUT = {_POSE}, {anchor}, {landmark}, {end}\n"
        f"DELAY, INTRINSICS = {CAMERA_DELAY_COLUMN}, {CAMERA_INTRINSICS_COLUMN}\n\n\n"
    )
    names = ("camera", "visual_common", "window_calibration", "window")
    return "\n\n".join([_HEADER + places + _camera_source(), *map(template_source, names)])


def _camera_source() -> str:
    """Return the functions of all projections and distortions, and those that choose among them."""
    from maplab_py.estimation.symbolic import cameras

    point = "parameters, c, x, y, z"
    plane = "parameters, c, k, x, y"
    parts = []
    for projection in Projection:
        function, mirror = cameras.denominator(projection), MIRROR_NAMES[projection]
        inputs = [["x", "y", "z"], [f"parameters[c, {1 + i}]" for i in range(len(mirror))]]
        name = projection.name.lower()
        values = ["D", "Dx", "Dy", "Dz"]
        lines = _lines(function, inputs, [values[:1], values[1:], None])
        lines.append(f"return {', '.join(values)}, {1 + len(mirror)}")
        parts.append(_function(f"denominator_{name}", point, lines))
        lines = _lines(function, inputs, [None, None, ["a", "b"]])
        lines.append(f"return {', '.join([*['a', 'b'][: len(mirror)], '0.0', '0.0'][:2])}")
        parts.append(_function(f"denominator_by_mirror_{name}", point, lines))
    for distortion in Distortion:
        function, size = cameras.distort(distortion), DISTORTION_SIZE[distortion]
        inputs = [["x", "y"], [f"parameters[c, k + {i}]" for i in range(size)]]
        name = distortion.name.lower()
        values = ["u", "v", "ux", "vx", "uy", "vy"]
        lines = _lines(function, inputs, [values[:2], values[2:], None])
        lines.append(f"return {', '.join(values)}")
        parts.append(_function(f"distort_{name}", plane, lines))
        out = [f"out[first + {i}]" for i in range(2 * size)]
        lines = _lines(function, inputs, [None, None, out])
        lines.append(f"return first + {2 * size}")
        parts.append(_function(f"distort_by_parameters_{name}", f"{plane}, out, first", lines))
    for name, arguments, models in (
        ("denominator", point, Projection),
        ("denominator_by_mirror", point, Projection),
        ("distort", plane, Distortion),
        ("distort_by_parameters", f"{plane}, out, first", Distortion),
    ):
        parts.append(_choice(name, arguments, [model.name.lower() for model in models]))
    return "".join(parts)


def _lines(
    function: Any, inputs: list[list[str]], outputs: Sequence[list[str] | None]
) -> list[str]:
    """Return the body of a function whose inputs and outputs are written as given."""
    from maplab_py.estimation.codegen.lowering import function_body

    return function_body(
        function,
        [places.__getitem__ for places in inputs],
        [None if places is None else places.__getitem__ for places in outputs],
    )


def _choice(name: str, arguments: str, models: list[str]) -> str:
    """Return a function that calls the one of the model whose number is `kind`."""
    lines = []
    for kind, model in enumerate(models[1:], 1):
        lines += [f"if kind == {kind}:", f"    return {name}_{model}({arguments})"]
    return _function(
        name, f"kind, {arguments}", [*lines, f"return {name}_{models[0]}({arguments})"]
    )


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
    residual = _function("residual", "x, r, J", lines, "@straight_line\n")
    return _HEADER + sizes + residual + template_source("batch")


def _pose_graph_source(kind: PoseError) -> str:
    from maplab_py.estimation.codegen.lowering import entries, function_body
    from maplab_py.estimation.symbolic import pose_graph

    error = {
        PoseError.SPLIT: pose_graph.split_error,
        PoseError.LOGARITHM: pose_graph.logarithmic_error,
    }[kind]
    functions: list[tuple[str, Any, str, list[str | None]]] = [
        ("error", pose_graph.linearised(error), "A, B, measured", ["e", None, None]),
        ("linearised", pose_graph.linearised(error), "A, B, measured", ["e", "J_B", "C"]),
        ("second", pose_graph.second_derivatives(error), "A, B, measured, g", ["AA", "BB", "BA"]),
        ("tilt", pose_graph.tilt(), "T, measured", ["e", "J"]),
        ("retraction", pose_graph.retraction(), "T, x", ["moved"]),
    ]
    parts = [_HEADER]
    for name, function, inputs, outputs in functions:
        places = [None if output is None else entries(output) for output in outputs]
        lines = function_body(function, [entries(x) for x in inputs.split(", ")], places)
        arguments = ", ".join([inputs, *(output for output in outputs if output is not None)])
        parts.append(_function(name, arguments, lines, "@straight_line\n"))
    return "".join([*parts, template_source("pose_graph")])


def _function(name: str, arguments: str, lines: list[str], decorator: str = _FAST) -> str:
    return decorator + f"def {name}({arguments}):\n    " + "\n    ".join(lines) + "\n\n\n"
