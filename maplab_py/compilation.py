"""The decorator that compiles kernels with numba and keeps their machine code; `prange`, `numba`.

Only this module imports numba, and `numba_changes` for it: before, it fixes the processor that numba compiles
for, so that kernels give the same bits on all processors that can run them. `MAPLAB_NATIVE=1` compiles
for this processor; NUMBA_CPU_NAME names any other.

Machine code is found by content. Its folder is named by what compiled it, its file by a hash of the
types of the arguments and of all that decides what numba makes of the function: the instructions of the
function and of those that it calls, and the values of their constants. Time stamps, paths and line
numbers do not count. It comes from the package, if the wheel brings it, else from the user's cache.

A module with kernels, or the module that calls them, has a function `compile_kernels`. It calls the
kernels once with small arguments of the types that commands use. `maplab_py.warmup` calls all of them.
"""

import enum
import hashlib
import os
import pickle
import platform
import sys
from collections.abc import Callable, Iterator, Set
from functools import cache
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

import llvmlite.binding as llvm
import numpy as np

from maplab_py import kernel_cache
from maplab_py.atomic import write_file
from maplab_py.kernel_cache import PACKAGED, cache_folder

_SECOND_LEVEL = {"cx16", "popcnt", "sahf", "sse3", "sse4.1", "sse4.2", "ssse3"}
_X86_LEVELS = {
    "x86-64-v3": _SECOND_LEVEL | {"avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe"},
    "x86-64-v2": _SECOND_LEVEL,
    "x86-64": set[str](),
}
"""Processors that kernels are compiled for, and features without which they do not run."""


def target_processor(machine: str, features: Set[str]) -> str:
    """Return LLVM's name of the processor that kernels are compiled for.

    Args:
        machine: The architecture as `platform.machine` names it.
        features: What the processor can do, in LLVM's names.
    """
    if machine.lower() not in ("x86_64", "amd64"):
        return "generic"
    return next(level for level, needed in _X86_LEVELS.items() if needed <= features)


# Threads sleep at the end of a parallel loop: on a busy machine, those that spin, GNU OpenMP's default,
# cost a time slice of the scheduler (measured: 60 ms instead of 2 ms)
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
if not (os.environ.get("MAPLAB_NATIVE") == "1" or os.environ.get("NUMBA_CPU_NAME")):
    _features = {name for name, is_there in llvm.get_host_cpu_features().items() if is_there}
    os.environ["NUMBA_CPU_NAME"] = target_processor(platform.machine(), _features)
    os.environ["NUMBA_CPU_FEATURES"] = ""
    # Intel's vector functions, which some distributions install, give other bits than libm
    os.environ.setdefault("NUMBA_DISABLE_INTEL_SVML", "1")
# numba colours the messages of all attempts at typing that fail, though nobody sees them
os.environ.setdefault("NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING", "1")

import numba  # noqa: E402 - it reads the environment when it is imported
import numba.extending  # noqa: E402 - for the modules that get numba from here
from numba.core.caching import FunctionCache  # noqa: E402
from numba.core.dispatcher import Dispatcher  # noqa: E402
from numba.core.extending import _Intrinsic  # noqa: E402
from numba.core.registry import CPUDispatcher  # noqa: E402
from numba.core.runtime.nrt import rtsys  # noqa: E402
from numba.core.sigutils import normalize_signature  # noqa: E402
from numba.core.targetconfig import ConfigStack  # noqa: E402

from maplab_py import numba_changes  # noqa: E402

__all__ = ["TARGET", "compiled", "numba", "prange", "target_processor"]

prange: Any = numba.prange
_types: Any = numba.types

_CHANGES = hashlib.sha256(Path(numba_changes.__file__).read_bytes()).hexdigest()[:8]
TARGET = (
    f"code-{sys.implementation.cache_tag}-numba-{numba.__version__}.{_CHANGES}"
    f"-numpy-{'.'.join(np.__version__.split('.')[:2])}-{os.environ.get('NUMBA_CPU_NAME', 'native')}"
)
"""Folder of machine code in the package and in the user's cache."""


def compiled(**settings: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator that compiles a function at its first call and keeps its machine code.

    Where no folder can be written, every process compiles the function again.

    Division by zero gives infinity or not-a-number, as in numpy. An exception would need a branch at
    each division and increase the compilation time by a tenth.

    Args:
        settings: Further settings of `numba.njit`, e.g. `parallel=True`.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        return function if numba.config.DISABLE_JIT else _Kernel(function, {}, options)

    options = {"nopython": True, "error_model": "numpy", "nogil": True, **settings}
    return decorate


class _Kernel(CPUDispatcher):  # type: ignore[misc]
    """A function that gets the wrapper for calls from Python only if there are such calls.

    Those that only other kernels call would need a fifth more time to compile with one.
    """

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._compiler._customize_flags = _leave_out_wrappers
        self._cache = _KernelCache(self)
        self._with_wrapper: set[Any] = set()

    def compile(self, sig: Any) -> Any:
        """Compile for the types of arguments, again if only kernels could call the function."""
        arguments = tuple(normalize_signature(sig)[0])
        if not _is_inside() and arguments not in self._with_wrapper:
            self.overloads.pop(arguments, None)
        if _is_inside():
            return super().compile(sig)
        with kernel_cache.compilation():
            return super().compile(sig)

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Take numbers in the code of the caller for any numbers, so that one function serves all."""
        try:
            return super().get_call_template(tuple(map(_types.unliteral, args)), kws)
        except numba.core.errors.TypingError:  # e.g. an index of a tuple
            return super().get_call_template(args, kws)

    def add_overload(self, cres: Any) -> None:
        """Let Python find what has a wrapper."""
        arguments = tuple(cres.signature.args)
        if _is_inside():
            self.overloads[arguments] = cres
        else:
            self._with_wrapper.add(arguments)
            super().add_overload(cres)


def _is_inside() -> bool:
    """Tell whether a kernel that calls the one at hand is being compiled."""
    return ConfigStack.top_or_none() is not None


def _leave_out_wrappers(flags: Any) -> Any:
    flags.no_cfunc_wrapper = True
    flags.no_cpython_wrapper = _is_inside()
    return flags


numba_changes.load_little()
numba_changes.make_code_when_needed()


class _KernelCache(FunctionCache):  # type: ignore[misc]
    """The machine code of one function on disk, a file for each set of argument types."""

    cache_path = ""

    def __init__(self, kernel: Any) -> None:
        self._kernel = kernel
        self._enabled = kernel.py_func.__closure__ is None

    def flush(self) -> None:
        """Keep the files: others have the same content."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return a kernel from disk, else nothing; only then numba's tables of functions are filled."""
        rtsys.initialize(target_context)
        loaded = self._load_overload(sig, target_context)
        if loaded is None:
            numba_changes.change_compiler()
            target_context.refresh()
        return loaded

    def _load_overload(self, sig: Any, target_context: Any) -> Any:
        if not self._enabled:
            return None
        name = self._file_name(sig, target_context.codegen())
        for folder in (_packaged_folder, cache_folder):
            path = folder(TARGET) / name
            if path.exists():
                parts = pickle.loads(path.read_bytes())
                return numba.core.compiler.CompileResult._rebuild(target_context, *parts)
        kernel_cache.is_compiling.set()
        return None

    def _save_overload(self, sig: Any, data: Any) -> None:
        if not self._enabled or data.lifted or data.library.has_dynamic_globals:
            return
        parts = list(data._reduce())
        parts[6] = ""  # the annotated source, which nobody reads, with the path of its file
        path = cache_folder(TARGET) / self._file_name(sig, data.codegen)
        write_file(path, [numba.core.serialize.dumps(tuple(parts))], durable=False)

    def _file_name(self, sig: Any, codegen: Any) -> str:
        function = self._kernel.py_func
        content = [f"inside: {_is_inside()}", repr(sig), _fields(sig), repr(codegen.magic_tuple())]
        content += _content(self._kernel)
        digest = hashlib.sha256("\0".join(content).encode()).hexdigest()[:32]
        name = f"{function.__module__.rpartition('.')[2]}.{function.__qualname__}"
        return f"{name.replace('<', '').replace('>', '')}-{digest}.nbc"


@cache
def _packaged_folder(target: str) -> Path:
    """Return a folder of the package; tell once if the wheel brings others instead."""
    others = sorted(path.name for path in PACKAGED.glob("code-*"))
    if others and target not in others:
        kernel_cache.tell_user(
            f"the installed kernels are {', '.join(others)}, not {target}: compiling them again, "
            "once, when they are needed (maplab warmup compiles all)"
        )
    return PACKAGED / target


def _fields(kinds: Any) -> str:
    """Return the names of the fields of named tuples, which their types do not tell."""
    tuples = [each for each in kinds if isinstance(each, _types.BaseTuple)]
    return repr([(getattr(each, "fields", ()), _fields(each.types)) for each in tuples])


@cache
def _content(kernel: Any) -> list[str]:
    """Return all that decides what numba makes of a function, but the types of its arguments."""
    kernels = [kernel]  # and those that they call: it grows in the loop
    return [part for each in kernels for part in _content_of_function(each, kernels)]


def _content_of_function(kernel: Any, kernels: list[Any]) -> Iterator[str]:
    function = kernel.py_func
    yield f"{function.__module__} {function.__qualname__} {_describe(function.__defaults__)}"
    yield repr(sorted((key, _describe(value)) for key, value in kernel.targetoptions.items()))
    codes = [function.__code__]  # and those of functions inside: it grows in the loop
    for code in codes:
        codes += [each for each in code.co_consts if isinstance(each, CodeType)]
        yield f"{code.co_code.hex()} {code.co_varnames} {code.co_names} {_describe(code.co_consts)}"
        values = _named(code.co_names, function.__globals__)
        modules = [each for each in values if isinstance(each, ModuleType)]
        for value in (*values, *(x for each in modules for x in _named(code.co_names, vars(each)))):
            yield _describe(value)
            if isinstance(value, _Intrinsic) and hasattr(value, "straight_line"):
                codes.append(value.straight_line.__code__)
                yield repr(value.settings)
            if isinstance(value, Dispatcher) and value not in kernels:
                kernels.append(value)


def _named(names: tuple[str, ...], scope: dict[str, Any]) -> list[Any]:
    return [scope[name] for name in names if name in scope]


def _describe(value: Any) -> str:
    """Return the content of what numba takes for a constant, else nothing."""
    if isinstance(value, set | frozenset):
        return repr(sorted(map(_describe, value)))
    if isinstance(value, np.ndarray):
        return f"{value.dtype} {value.shape} {hashlib.sha256(value.tobytes()).hexdigest()}"
    if isinstance(value, tuple):
        return repr([_describe(each) for each in value])
    if isinstance(value, bool | int | float | complex | str | enum.Enum | np.generic):
        return repr(value)
    if isinstance(value, type):
        members = list(value) if issubclass(value, enum.Enum) else getattr(value, "_fields", "")
        return f"{value.__qualname__} {members}"
    if isinstance(value, _types.ExternalFunction):
        return f"{value.symbol} {value.sig}"
    return ""
