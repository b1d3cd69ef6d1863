"""Changes to numba's compiler that make compilation shorter and leave the results of kernels as they are.

`compilation` imports this module, after it has set the processor, and nothing else does.
"""

from __future__ import annotations

from functools import cache
from operator import attrgetter
from typing import Any

import numba
import numba.extending
from numba.core import cgutils, entrypoints, environment, event, ir
from numba.core.codegen import CPUCodeLibrary, JITCodeLibrary, JITCPUCodegen
from numba.core.environment import lookup_environment
from numba.core.lowering import Lower
from numba.core.postproc import PostProcessor, VariableLifetime
from numba.core.targetconfig import ConfigStack
from numba.core.transforms import canonicalize_cfg

types: Any = numba.types


@cache
def change_compiler() -> None:
    """Make all changes of this module but those that loading kernels needs."""
    _leave_out_what_nobody_reads()
    _remember_types()
    _borrow_arguments()
    _index_directly()


def _leave_out_what_nobody_reads() -> None:
    """Leave out events, lives of variables before references are counted, and the shapes in an error's text.

    They are a third of the time: functions that print numbers are compiled for each assignment to a part
    of an array.
    """
    from numba.np import arrayobj

    run = PostProcessor.run

    def post_process(self: Any, emit_dels: bool = False, extend_lifetimes: bool = False) -> None:
        function = self.func_ir
        if emit_dels or function.is_generator:
            run(self, emit_dels, extend_lifetimes)
            return
        function.blocks = canonicalize_cfg(function.blocks)
        function.variable_lifetime = VariableLifetime(function.blocks)
        function.generator_info = None

    def variables(_: Any, value: Any) -> list[Any]:
        result, rest = [], [value]
        while rest:
            each = rest.pop()
            if isinstance(each, ir.Var):
                result.append(each)
            elif isinstance(each, ir.Inst):
                result += each.list_vars()
            elif isinstance(each, list | tuple | dict):
                rest += reversed(each.values() if isinstance(each, dict) else each)
        return result

    def raise_error(source: Any, target: Any) -> None:
        """Stand for the function that raises the error in kernels."""

    PostProcessor.run, ir.Inst._rec_list_vars = post_process, variables
    event.start_event = event.end_event = lambda *_, **__: None
    numba.extending.overload(raise_error)(arrayobj.ol_raise_with_shape_context_generic)
    arrayobj.raise_with_shape_context = raise_error


def _remember_types() -> None:
    """Let numba resolve the type of `a + b` or `a[i]` once for each set of types, not at each place.

    It is a third of the time that numba needs for a function. Flags are a part of what is remembered, since
    functions of numba itself are compiled with some of those of their caller; the others do not count,
    and none of these functions is called through a pointer.
    """
    function, flags_type = types.Function, numba.core.compiler.Flags
    resolve = function.get_call_type
    inherited = attrgetter("nrt", "fastmath", "error_model", "forceinline")

    def get_call_type(self: Any, context: Any, args: Any, kws: Any) -> Any:
        known = self.__dict__.setdefault("_known_calls", {})
        flags = ConfigStack.top_or_none()
        key = (context, tuple(args), flags and flags.copy())
        if kws or key not in known:
            signature = resolve(self, context, args, kws)
            if kws or signature is None or not all(each.is_precise() for each in args):
                return signature
            known[key] = signature, self._impl_keys[signature.args]
        signature, implementation = known[key]
        self._impl_keys[signature.args] = implementation
        return signature

    def equal(self: Any, other: Any) -> bool:
        return isinstance(other, flags_type) and inherited(self) == inherited(other)

    def customize_flags(self: Any, flags: Any) -> Any:
        flags.no_cfunc_wrapper |= self.py_func.__module__.startswith("numba.")
        return flags

    function.get_call_type = get_call_type
    flags_type.__eq__ = equal
    flags_type.__hash__ = lambda _: hash(flags_type)
    numba.core.dispatcher._FunctionCompiler._customize_flags = customize_flags


def load_little() -> None:
    """Let numba load kernels without its extensions and the modules of the functions that they contain.

    Compiled code does not read the names in those modules; scipy, which some import, takes 0.15 s.
    """
    make = environment._rebuild_env

    def make_environment(module: str, constants: Any, name: str) -> Any:
        return make("numba" if module.startswith("numba.") else module, constants, name)

    environment._rebuild_env = make_environment
    entrypoints._already_initialized = True


def make_code_when_needed() -> None:
    """Let LLVM optimise functions and make machine code where Python calls them, with all that they call.

    Functions that only other functions call are linked into those as they are; numba optimises them in every
    function on the way, and makes code of each that never runs. That is half of LLVM's time.
    """
    library, set_environment = CPUCodeLibrary, JITCPUCodegen.set_env
    optimise, make_code = library._optimize_final_module, library._finalize_final_module
    find, serialise = JITCodeLibrary.get_pointer_to_function, library.serialize_using_object_code

    def finalise(self: Any) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True
        if getattr(self, "_compiled_object", None):  # it comes from the cache
            make_code(self)

    def get_pointer_to_function(self: Any, name: str) -> Any:
        self._ensure_finalized()
        functions = self._final_module.functions
        is_here = any(each.name == name and not each.is_declaration for each in functions)
        if is_here and not hasattr(self, "has_code"):
            self.has_code = True
            self._get_module_for_linking()  # before it is optimised: others link the same in any order
            optimise(self)
            make_code(self)
            for each in self._final_module.global_variables:
                if environment := lookup_environment(each.name):
                    set_environment(self._codegen, each.name, environment)
        return find(self, name)

    def serialize_using_object_code(self: Any) -> Any:
        is_code = getattr(self, "_compiled_object", None)
        return serialise(self) if is_code else self.serialize_using_bitcode()

    def set_env(self: Any, name: str, environment: Any) -> None:
        if self._engine.is_symbol_defined(name):
            set_environment(self, name, environment)

    library._optimize_final_module = lambda _: None
    library._finalize_final_module = finalise
    library.serialize_using_object_code = serialize_using_object_code
    JITCodeLibrary.get_pointer_to_function = get_pointer_to_function
    JITCPUCodegen.set_env = set_env


def _borrow_arguments() -> None:
    """Let numba count no references to arguments and their parts, which the caller holds during the call.

    Counting is a quarter of the instructions that LLVM gets, and it removes nearly all of them.
    """
    lower_inst, delvar = Lower.lower_inst, Lower.delvar

    def lower_statement(self: Any, statement: Any) -> None:
        context = self.context
        if isinstance(statement, ir.Assign) and statement.target.name in _borrowed(self):
            self.context = context.subtarget(enable_nrt=False)
        try:
            lower_inst(self, statement)
        finally:
            self.context = context

    def delete(self: Any, name: str) -> None:
        if name in _borrowed(self) or not _has_references(self, name):
            if name not in self._blk_local_varmap:
                self._singly_assigned_vars.discard(name)
        else:
            delvar(self, name)

    Lower.lower_inst, Lower.delvar = lower_statement, delete


def _has_references(lower: Any, name: str) -> bool:
    return _contains_references(lower.context.data_model_manager, lower.typeof(name))


@cache
def _contains_references(manager: Any, kind: Any) -> bool:
    return bool(manager[kind].contains_nrt_meminfo())


def _borrowed(lower: Any) -> set[str]:
    """Return the variables of a function that hold nothing but arguments, their parts and views of them."""
    if "borrowed" not in lower.__dict__:
        lower.borrowed = set() if lower.generator_info else _find_borrowed(lower)
    borrowed: set[str] = lower.borrowed
    return borrowed


def _find_borrowed(lower: Any) -> set[str]:
    values: dict[str, list[Any]] = {}
    owned = set()  # what the function returns, and what parallel loops set
    for statement in (each for block in lower.blocks.values() for each in block.body):
        if isinstance(statement, ir.Assign):
            values.setdefault(statement.target.name, []).append(statement.value)
        elif isinstance(statement, ir.Return):
            owned.add(statement.value.name)
        elif hasattr(statement, "init_block"):
            owned.update(statement.redvars)
            owned.update(
                x.target.name for x in statement.init_block.body if isinstance(x, ir.Assign)
            )
    kinds = types.Array, types.BaseTuple, types.BoundFunction
    names = {name for name in values if isinstance(lower.typeof(name), kinds)} - owned
    before = None
    while before != names:
        before = names
        names = {
            name for name in names if all(_is_borrowed(x, before, lower) for x in values[name])
        }
    return names


def _is_borrowed(value: Any, names: set[str], lower: Any) -> bool:
    """Tell whether a value is an argument, or a part or view of what variables with these names hold."""

    def borrows(*variables: Any) -> bool:
        return all(x.name in names or not _has_references(lower, x.name) for x in variables)

    if isinstance(value, ir.Var):
        return value.name in names
    if not isinstance(value, ir.Expr):
        return isinstance(value, ir.Arg)
    match value.op:
        case "getattr" if value.attr == "imag":  # of real numbers, it is made
            return False
        case "getattr" | "static_getitem" | "exhaust_iter" | "cast":
            return value.value.name in names
        case "getitem":  # an index that is an array makes a copy
            return value.value.name in names and not _has_references(lower, value.index.name)
        case "build_tuple":
            return borrows(*value.items)
        case "call":
            function = lower.typeof(value.func.name)
            is_view = getattr(function, "typing_key", None) == "array.reshape"
            is_tuple = isinstance(function, types.NamedTupleClass)
            named = [variable for _, variable in value.kws]
            rest = [value.vararg] if value.vararg else []
            return (is_view and borrows(value.func)) or (
                is_tuple and borrows(*value.args, *named, *rest)
            )
    return False


def _index_directly() -> None:
    """Let numba read and write an element of an array by the instructions for its address alone.

    Through a description of the array on the stack they are twice as many, half of those of many kernels.
    """
    from numba.np.arrayobj import load_item, store_item

    lower_getitem, lower_setitem = Lower.lower_getitem, Lower.lower_setitem

    def getitem(self: Any, kind: Any, expr: Any, value: Any, index: Any, signature: Any) -> Any:
        if not _is_element(signature):
            return lower_getitem(self, kind, expr, value, index, signature)
        context, array = self.context, signature.args[0]
        element = load_item(context, self.builder, array, _place(self, value, index, signature))
        return context.cast(self.builder, element, signature.return_type, kind)

    def setitem(self: Any, target: Any, index: Any, value: Any, signature: Any) -> Any:
        if not _is_element(signature):
            return lower_setitem(self, target, index, value, signature)
        context, array = self.context, signature.args[0]
        place = _place(self, target, index, signature)
        known = self.typeof(value.name)
        element = context.cast(self.builder, self.loadvar(value.name), known, array.dtype)
        return store_item(context, self.builder, array, element, place)

    Lower.lower_getitem, Lower.lower_setitem = getitem, setitem


def _is_element(signature: Any) -> bool:
    """Tell whether a signature of `[]` is of a number in an array, with an integer for each dimension."""
    array, index, *value = signature.args
    indices = index if isinstance(index, types.BaseTuple) else (index,)
    return (
        isinstance(array, types.Array)
        and isinstance(array.dtype, types.Number | types.Boolean)
        and len(indices) == array.ndim
        and all(isinstance(each, types.Integer) for each in indices)
        and all(isinstance(each, types.Number | types.Boolean) for each in value)
    )


def _place(lower: Any, array: Any, index: Any, signature: Any) -> Any:
    """Return the address of an element; negative indices count from the end."""
    from numba.np.arrayobj import fix_integer_index

    context, builder, (kind, index_kind, *_) = lower.context, lower.builder, signature.args
    value = context.cast(builder, lower.loadvar(array.name), lower.typeof(array.name), kind)
    field = context.data_model_manager[kind].get_field_position
    data, sizes = (builder.extract_value(value, field(name)) for name in ("data", "shape"))
    sizes, steps = cgutils.unpack_tuple(builder, sizes, kind.ndim), []
    if kind.layout == "A":
        steps = builder.extract_value(value, field("strides"))
        steps = cgutils.unpack_tuple(builder, steps, kind.ndim)
    known = lower.typeof(index.name)
    indices = context.cast(builder, lower.loadvar(index.name), known, index_kind)
    kinds = [index_kind]
    if isinstance(index_kind, types.BaseTuple):
        kinds, indices = list(index_kind), cgutils.unpack_tuple(builder, indices, kind.ndim)
    else:
        indices = [indices]
    indices = [
        fix_integer_index(context, builder, *each)
        for each in zip(kinds, indices, sizes, strict=True)
    ]
    check = context.enable_boundscheck
    return cgutils.get_item_pointer2(
        context, builder, data, sizes, steps, kind.layout, indices, boundscheck=check
    )
