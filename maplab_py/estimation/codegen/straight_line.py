"""Functions without branches, lowered to LLVM as they are.

numba infers a type for each of a thousand intermediate results that are all real numbers: most of the
time it takes for such a function. Here each operation becomes one instruction, in the same order. An
operation on a row of numbers becomes one instruction, too, which processors have for four at a time.
"""

import ast
import inspect
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from llvmlite import ir

from maplab_py.array_types import F64
from maplab_py.compilation import numba

_REAL = numba.types.float64
_CONTRACT = ("contract", "nsz")
_BYTES = 8
_INSTRUCTIONS = {ast.Add: "fadd", ast.Sub: "fsub", ast.Mult: "fmul", ast.Div: "fdiv"}
_COMPARISONS = {ast.Lt: "<", ast.LtE: "<=", ast.Eq: "==", ast.NotEq: "!="}


def straight_line(function: Callable[..., None], width: int = 1, *, contracts: bool = True) -> Any:
    """Return what kernels call for a function of contiguous arrays of real numbers, and of numbers.

    Args:
        function: Assigns sums, products, functions of `math` and choices between two values, of real
            arguments and entries, also of rows, to names and to entries. Indices are sums and products
            of constants, integers among the arguments and variables of loops over `range(CONSTANT)`. It
            has no other statements. A row that has a name is not written while the name is in use:
            without compilation (NUMBA_DISABLE_JIT=1) the name would change with it.
        width: Length of the last axis of arrays that are indexed by one index less than they have axes,
            and number of arguments of `row`. Sums and products of rows, and of rows and numbers, are rows.
        contracts: Whether a product and a sum may be one operation, which is rounded once.
    """

    if numba.config.DISABLE_JIT:
        return function
    names = list(inspect.signature(function).parameters)

    def define(_: Any, *arguments: Any) -> Any:
        if not all(
            isinstance(each, numba.types.Number) or getattr(each, "layout", "") == "C"
            for each in arguments
        ):
            return None

        def lower(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            lowering = _Lowering(context, builder, width, _CONTRACT if contracts else ())
            for name, kind, value in zip(names, signature.args, values, strict=True):
                lowering.add_argument(name, kind, value)
            lowering.lower(function)
            return context.get_dummy_value()

        return numba.types.void(*arguments), lower

    # for numba's messages, and it counts the arguments, of which the first is the context
    define.__name__ = function.__name__
    define.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
        [inspect.Parameter(name, inspect.Parameter.POSITIONAL_ONLY) for name in ["_", *names]]
    )
    intrinsic = numba.extending.intrinsic(define)
    intrinsic.straight_line, intrinsic.settings = function, (width, contracts)
    return intrinsic


rows_of_six = partial(straight_line, width=6)


def row(*entries: float) -> F64:
    """Return a row of entries, in a function that is lowered."""
    return np.array(entries)


class _Lowering:
    """The values of names while the statements of a function become instructions."""

    def __init__(self, context: Any, builder: Any, width: int, flags: tuple[str, ...]) -> None:
        self._context, self._builder, self._flags = context, builder, flags
        self._row = ir.VectorType(ir.DoubleType(), width)
        self._arrays: dict[str, tuple[Any, Any]] = {}  # type and value
        self._values: dict[str, Any] = {}

    def add_argument(self, name: str, kind: Any, value: Any) -> None:
        """Name an argument of a type."""
        if isinstance(kind, numba.types.Number):
            common = numba.types.intp if isinstance(kind, numba.types.Integer) else _REAL
            self._values[name] = self._context.cast(self._builder, value, kind, common)
        else:
            array = self._context.make_array(kind)(self._context, self._builder, value)
            if self._row.count > 1:
                array.data = self._as_unknown(array.data)
            self._arrays[name] = kind, array

    def _as_unknown(self, pointer: Any) -> Any:
        """Return a pointer of which LLVM knows nothing, by an empty line of assembly.

        It would load the numbers of rows before the loop of the caller, to more registers than there are.
        """
        signature = ir.FunctionType(pointer.type, [pointer.type])
        nothing = ir.InlineAsm(signature, "", "=r,0", side_effect=True)
        return self._builder.call(nothing, [pointer])

    def lower(self, function: Callable[..., None]) -> None:
        """Append the instructions of all statements."""
        self._constants = function.__globals__
        (definition,) = ast.parse(inspect.getsource(function)).body
        assert isinstance(definition, ast.FunctionDef)
        self._lower_all(definition.body)

    def _lower_all(self, statements: list[ast.stmt]) -> None:
        for statement in statements:
            match statement:
                case ast.Assign(targets=[ast.Name(id=name)]):
                    self._values[name] = self._value(statement.value)
                case ast.Assign(targets=[ast.Subscript() as target]):
                    value = self._value(statement.value)
                    self._builder.store(value, self._place(target), align=_BYTES)
                case ast.For(
                    target=ast.Name(id=name), iter=ast.Call(args=[ast.Constant(value=int(end))])
                ):
                    for index in range(end):
                        self._values[name] = self._context.get_constant(numba.types.intp, index)
                        self._lower_all(statement.body)
                case ast.Expr(value=ast.Constant()):  # a docstring
                    pass
                case _:
                    raise ValueError(f"no instructions for {ast.dump(statement)}")

    def _place(self, node: Any) -> Any:
        """Return the address of an entry, or of a row if there is an index less than axes."""
        kind, array = self._arrays[node.value.id]
        nodes = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
        indices = [self._index(each) for each in nodes]
        is_row = len(indices) < kind.ndim
        if is_row:
            indices.append(self._context.get_constant(numba.types.intp, 0))
        place = numba.core.cgutils.get_item_pointer(
            self._context, self._builder, kind, array, indices, wraparound=False
        )
        return self._builder.bitcast(place, self._row.as_pointer()) if is_row else place

    def _index(self, node: Any) -> Any:
        match node:
            case ast.Name(id=name) if name in self._values:
                return self._values[name]
            case ast.BinOp(op=ast.Add()):
                return self._builder.add(self._index(node.left), self._index(node.right))
            case ast.BinOp(op=ast.Mult()):
                return self._builder.mul(self._index(node.left), self._index(node.right))
        constant = self._constants[node.id] if isinstance(node, ast.Name) else node.value
        return self._context.get_constant(numba.types.intp, constant)

    def _value(self, node: Any) -> Any:
        builder = self._builder
        match node:
            case ast.Name():
                return self._values[node.id]
            case ast.Constant():
                return self._context.get_constant(_REAL, node.value)
            case ast.Subscript(value=ast.Name(id=name)) if name in self._values:  # of a row
                return builder.extract_element(self._values[name], self._index(node.slice))
            case ast.Subscript():
                return builder.load(self._place(node), align=_BYTES)
            case ast.UnaryOp(op=ast.USub()):
                return builder.fneg(self._value(node.operand), flags=self._flags)
            case ast.BinOp() if type(node.op) in _INSTRUCTIONS:
                instruction = getattr(builder, _INSTRUCTIONS[type(node.op)])
                left, right = self._value(node.left), self._value(node.right)
                if left.type != right.type:
                    left, right = self._as_row(left), self._as_row(right)
                return instruction(left, right, flags=self._flags)
            case ast.IfExp(test=ast.Compare() as test):
                condition = self._condition(test)
                return builder.select(condition, self._value(node.body), self._value(node.orelse))
            case ast.Call(func=ast.Name(id="row")):
                result = ir.Constant(self._row, ir.Undefined)
                for place, each in enumerate(node.args):
                    index = ir.IntType(32)(place)
                    result = builder.insert_element(result, self._value(each), index)
                return result
            case ast.Call():
                arguments = [self._value(each) for each in node.args]
                function = (
                    getattr(math, node.func.attr) if hasattr(node.func, "attr") else math.fabs
                )
                signature = _REAL(*[_REAL] * len(arguments))
                return self._context.get_function(function, signature)(builder, arguments)
        raise ValueError(f"no instruction for {ast.dump(node)}")

    def _as_row(self, value: Any) -> Any:
        """Return a row of a number, or the row itself."""
        if value.type == self._row:
            return value
        undefined, zero = ir.Constant(self._row, ir.Undefined), ir.IntType(32)(0)
        first = self._builder.insert_element(undefined, value, zero)
        everywhere = ir.Constant(ir.VectorType(ir.IntType(32), self._row.count), None)
        return self._builder.shuffle_vector(first, undefined, everywhere)

    def _condition(self, node: ast.Compare) -> Any:
        (operation,), (right,) = node.ops, node.comparators
        compare = self._builder.fcmp_ordered
        if isinstance(operation, ast.NotEq):  # true where one is not a number
            compare = self._builder.fcmp_unordered
        return compare(_COMPARISONS[type(operation)], self._value(node.left), self._value(right))
