"""Changes to numba's compiler that make compilation shorter and leave the results of kernels as they are.

`compilation` imports this module, after it has set the processor, and nothing else does.
"""

from functools import cache
from operator import attrgetter
from typing import Any

import llvmlite.binding as llvm
import numba
import numba.extending
from numba.core import cgutils, entrypoints, environment, event
from numba.core.codegen import CPUCodeLibrary, JITCodeLibrary, JITCPUCodegen
from numba.core.environment import lookup_environment
from numba.core.lowering import Lower
from numba.core.targetconfig import ConfigStack

types: Any = numba.types


@cache
def change_compiler() -> None:
    """Make all changes of this module but those that loading kernels needs."""
    _remember_types()
    _index_directly()


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
    """Let numba load kernels without events, extensions, and the modules of the functions in them.

    Compiled code does not read the names in those modules; scipy, which some import, takes 0.15 s.
    """
    make = environment._rebuild_env

    def make_environment(module: str, constants: Any, name: str) -> Any:
        return make("numba" if module.startswith("numba.") else module, constants, name)

    environment._rebuild_env = make_environment
    entrypoints._already_initialized = True
    event.start_event = event.end_event = lambda *_, **__: None


def make_code_when_needed() -> None:
    """Let LLVM optimise functions and make machine code where Python calls them, with all that they call.

    Functions that only other functions call are linked into those as they are; numba optimises them in every
    function on the way, and makes code of each that never runs. That is half of LLVM's time.
    """
    library, set_environment = CPUCodeLibrary, JITCPUCodegen.set_env
    optimise, make_code = library._optimize_final_module, library._finalize_final_module
    find, serialise = JITCodeLibrary.get_pointer_to_function, library.serialize_using_object_code
    link = library._get_module_for_linking

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
        if not getattr(self, "_compiled_object", None):
            return self.serialize_using_bitcode()
        name, kind, parts = serialise(self)
        module = self._get_module_for_linking()
        known = (*module.functions, *module.global_variables)
        return name, kind, (*parts, sorted(x.name for x in known if not x.is_declaration))

    def deserialise(codegen: Any, state: Any) -> Any:
        name, kind, parts = state
        if kind == "bitcode":
            return codegen._library_class._unserialize(codegen, state)
        self = codegen.create_library(name)
        self.enable_object_caching()
        code, self.bitcode, symbols = parts
        self._set_compiled_object(code)
        self._finalize_final_module()
        codegen._engine._defined_symbols.update(symbols)
        return self

    def get_module_for_linking(self: Any) -> Any:
        if bitcode := self.__dict__.pop("bitcode", None):
            self._shared_module = llvm.parse_bitcode(bitcode)
        return link(self)

    def set_env(self: Any, name: str, environment: Any) -> None:
        if self._engine.is_symbol_defined(name):
            set_environment(self, name, environment)

    library._optimize_final_module = lambda _: None
    library._finalize_final_module = finalise
    library.serialize_using_object_code = serialize_using_object_code
    library._get_module_for_linking = get_module_for_linking
    JITCPUCodegen.unserialize_library = deserialise
    JITCodeLibrary.get_pointer_to_function = get_pointer_to_function
    JITCPUCodegen.set_env = set_env


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
