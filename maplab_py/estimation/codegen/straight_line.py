"""Generated functions without branches, lowered to LLVM as they are.

numba infers a type for each of a thousand intermediate results that are all real numbers: most of the
time it takes for such a function. Here each operation becomes one instruction, in the same order.
"""

import ast
import inspect
import math
from collections.abc import Callable
from typing import Any

from maplab_py.compilation import numba

_REAL = numba.types.float64
_CONTRACT = ("contract", "nsz")
_INSTRUCTIONS = {ast.Add: "fadd", ast.Sub: "fsub", ast.Mult: "fmul", ast.Div: "fdiv"}
_COMPARISONS = {ast.Lt: "<", ast.LtE: "<=", ast.Eq: "==", ast.NotEq: "!="}


def straight_line(function: Callable[..., None]) -> Any:
    """Return what kernels call for a function of contiguous one-dimensional arrays of real numbers.

    Args:
        function: Assigns sums, products, functions of `math` and choices between two values, of entries
            of its arguments with constant indices, to names and to entries. It has no other statements.
    """

    if numba.config.DISABLE_JIT:
        return function
    names = list(inspect.signature(function).parameters)

    def define(_: Any, *arguments: Any) -> Any:
        if not all(getattr(each, "layout", "") == "C" and each.ndim == 1 for each in arguments):
            return None

        def lower(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            pointers = {
                name: context.make_array(array)(context, builder, value).data
                for name, array, value in zip(names, signature.args, values, strict=True)
            }
            _Lowering(context, builder, pointers).lower(function)
            return context.get_dummy_value()

        return numba.types.void(*arguments), lower

    # for numba's messages, and it counts the arguments, of which the first is the context
    define.__name__ = function.__name__
    define.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
        [inspect.Parameter(name, inspect.Parameter.POSITIONAL_ONLY) for name in ["_", *names]]
    )
    intrinsic = numba.extending.intrinsic(define)
    intrinsic.straight_line = function
    return intrinsic


class _Lowering:
    """The values of names while the statements of a function become instructions."""

    def __init__(self, context: Any, builder: Any, pointers: dict[str, Any]) -> None:
        self._context, self._builder, self._pointers = context, builder, pointers
        self._values: dict[str, Any] = {}

    def lower(self, function: Callable[..., None]) -> None:
        """Append the instructions of all statements."""
        (definition,) = ast.parse(inspect.getsource(function)).body
        assert isinstance(definition, ast.FunctionDef)
        for statement in definition.body:
            assert isinstance(statement, ast.Assign)
            (target,), value = statement.targets, self._value(statement.value)
            if isinstance(target, ast.Name):
                self._values[target.id] = value
            else:
                self._builder.store(value, self._place(target))

    def _place(self, node: Any) -> Any:
        index = self._context.get_constant(numba.types.intp, node.slice.value)
        return self._builder.gep(self._pointers[node.value.id], [index], inbounds=True)

    def _value(self, node: Any) -> Any:
        builder = self._builder
        match node:
            case ast.Name():
                return self._values[node.id]
            case ast.Constant():
                return self._context.get_constant(_REAL, node.value)
            case ast.Subscript():
                return builder.load(self._place(node))
            case ast.UnaryOp(op=ast.USub()):
                return builder.fneg(self._value(node.operand), flags=_CONTRACT)
            case ast.BinOp() if type(node.op) in _INSTRUCTIONS:
                instruction = getattr(builder, _INSTRUCTIONS[type(node.op)])
                return instruction(self._value(node.left), self._value(node.right), flags=_CONTRACT)
            case ast.IfExp(test=ast.Compare() as test):
                condition = self._condition(test)
                return builder.select(condition, self._value(node.body), self._value(node.orelse))
            case ast.Call():
                arguments = [self._value(each) for each in node.args]
                function = (
                    getattr(math, node.func.attr) if hasattr(node.func, "attr") else math.fabs
                )
                signature = _REAL(*[_REAL] * len(arguments))
                return self._context.get_function(function, signature)(builder, arguments)
        raise ValueError(f"no instruction for {ast.dump(node)}")

    def _condition(self, node: ast.Compare) -> Any:
        (operation,), (right,) = node.ops, node.comparators
        compare = self._builder.fcmp_ordered
        if isinstance(operation, ast.NotEq):  # true where one is not a number
            compare = self._builder.fcmp_unordered
        return compare(_COMPARISONS[type(operation)], self._value(node.left), self._value(right))
