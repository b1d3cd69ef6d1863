"""Lower a casadi SX function to the body of a plain Python function that numba compiles.

A casadi SX function is a list of scalar instructions on work registers. Each becomes one line:
``w3 = w1 * w2``. Inputs and outputs are read and written through expressions that the caller
chooses, so that a kernel can index its arrays directly, without copies.
"""

from collections.abc import Callable, Sequence
from typing import Any

import casadi

ca: Any = casadi  # its stubs do not know mixed arguments

_UNARY = {
    ca.OP_ASSIGN: "{}",
    ca.OP_NEG: "-{}",
    ca.OP_SQ: "{0} * {0}",
    ca.OP_TWICE: "2.0 * {}",
    ca.OP_INV: "1.0 / {}",
    ca.OP_SQRT: "math.sqrt({})",
    ca.OP_SIN: "math.sin({})",
    ca.OP_COS: "math.cos({})",
    ca.OP_TAN: "math.tan({})",
    ca.OP_ATAN: "math.atan({})",
    ca.OP_ASIN: "math.asin({})",
    ca.OP_ACOS: "math.acos({})",
    ca.OP_EXP: "math.exp({})",
    ca.OP_LOG: "math.log({})",
    ca.OP_FABS: "abs({})",
    ca.OP_SIGN: "math.copysign(1.0, {})",
    ca.OP_NOT: "(1.0 if {} == 0.0 else 0.0)",
}
_BINARY = {
    ca.OP_ADD: "{} + {}",
    ca.OP_SUB: "{} - {}",
    ca.OP_MUL: "{} * {}",
    ca.OP_DIV: "{} / {}",
    ca.OP_POW: "{} ** {}",
    ca.OP_CONSTPOW: "{} ** {}",
    ca.OP_FMIN: "min({}, {})",
    ca.OP_FMAX: "max({}, {})",
    ca.OP_ATAN2: "math.atan2({}, {})",
    ca.OP_LT: "(1.0 if {} < {} else 0.0)",
    ca.OP_LE: "(1.0 if {} <= {} else 0.0)",
    ca.OP_EQ: "(1.0 if {} == {} else 0.0)",
    ca.OP_NE: "(1.0 if {} != {} else 0.0)",
    ca.OP_IF_ELSE_ZERO: "({1} if {0} != 0.0 else 0.0)",
}

Place = Callable[[int], str]
"""Gives the expression of one entry (column-major) of an input or output."""


def entries(array: str, offset: int = 0) -> Place:
    """Place the entries one after another: array[offset], array[offset + 1] ..."""
    return lambda k: f"{array}[{offset + k}]"


def row_entries(array: str, row: str, offset: int = 0) -> Place:
    """Place the entries along a row: array[row, offset], array[row, offset + 1] ..."""
    return lambda k: f"{array}[{row}, {offset + k}]"


def function_body(
    function: Any, inputs: Sequence[Place], outputs: Sequence[Place | None]
) -> list[str]:
    """Return the lines of the function's body.

    Args:
        function: casadi SX function.
        inputs: Where each input's entries are read.
        outputs: Where each output's entries go; None leaves an output out.

    Raises:
        ValueError: The function uses an operation that has no scalar counterpart here.
    """
    wanted = _instructions_needed(function, outputs)
    lines = []
    for k in range(function.n_instructions()):
        if not wanted[k]:
            continue
        operation = function.instruction_id(k)
        to, source = function.instruction_output(k), function.instruction_input(k)
        if operation == ca.OP_CONST:
            lines.append(f"w{to[0]} = {float(function.instruction_constant(k))!r}")
        elif operation == ca.OP_INPUT:
            lines.append(f"w{to[0]} = {inputs[source[0]](source[1])}")
        elif operation == ca.OP_OUTPUT:
            place = outputs[to[0]]
            assert place is not None
            lines.append(f"{place(to[1])} = w{source[0]}")
        elif operation in _UNARY:
            lines.append(f"w{to[0]} = " + _UNARY[operation].format(f"w{source[0]}"))
        elif operation in _BINARY:
            arguments = f"w{source[0]}", f"w{source[1]}"
            lines.append(f"w{to[0]} = " + _BINARY[operation].format(*arguments))
        else:
            raise ValueError(f"casadi operation {operation} has no counterpart in a kernel")
    return lines


def _instructions_needed(function: Any, outputs: Sequence[Place | None]) -> list[bool]:
    """Tell which instructions contribute to the wanted outputs (a backward sweep)."""
    count = function.n_instructions()
    needed = [False] * count
    live: set[int] = set()
    for k in range(count - 1, -1, -1):
        operation = function.instruction_id(k)
        to, source = function.instruction_output(k), function.instruction_input(k)
        if operation == ca.OP_OUTPUT:
            if outputs[to[0]] is not None:
                needed[k] = True
                live.add(source[0])
            continue
        if to[0] not in live:
            continue
        needed[k] = True
        live.discard(to[0])
        if operation not in (ca.OP_CONST, ca.OP_INPUT):
            live.update(source if operation in _BINARY else source[:1])
    return needed
