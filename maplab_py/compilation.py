"""The decorator that compiles kernels with numba and keeps their machine code; `prange`, `numba`.

This is the only module that imports numba: before, it fixes the processor that numba compiles for
(x86-64-v3, x86-64-v2, or the generic processor of another architecture), so that kernels give the
same bits on all processors that can run them, and machine code fits all of them. `MAPLAB_NATIVE=1`
compiles for this processor; NUMBA_CPU_NAME names any other.

Machine code is found by content: the name of its file is a hash of the sources that decide what is
in it, the types of the arguments, the versions of numba, numpy and Python, and the processor. Time
stamps, paths and line numbers do not count. A kernel's sources are its own file and, one after the
other, those of the compiled functions and the named tuples that its module imports; constants count by
value. Only functions and constants of modules count: a kernel refers to nothing else. Machine code
comes from the folder `_kernels` of the package, which a wheel brings, else from the user's cache,
where it is written when something is compiled.

A module with kernels, or the module that calls them, has a function `compile_kernels`. It calls the
kernels once with small arguments of the types that commands use. `maplab_py.warmup` calls all of them.

Threads sleep while they wait for others at the end of a parallel loop. By default, GNU OpenMP lets
them spin for milliseconds; on a busy machine every loop then costs a time slice of the scheduler
(measured: 60 ms instead of 2 ms). OpenMP reads the variable when numba loads it, at the first parallel
loop.
"""

from __future__ import annotations

import enum
import hashlib
import json
import os
import pickle
import platform
import sys
from collections.abc import Callable, Iterator, Set
from functools import cache
from pathlib import Path
from types import FunctionType, ModuleType
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


def _fix_target() -> None:
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    if os.environ.get("MAPLAB_NATIVE") == "1" or os.environ.get("NUMBA_CPU_NAME"):
        return
    features = {name for name, is_there in llvm.get_host_cpu_features().items() if is_there}
    os.environ["NUMBA_CPU_NAME"] = target_processor(platform.machine(), features)
    os.environ["NUMBA_CPU_FEATURES"] = ""
    # Intel's vector functions, which some distributions install, give other bits than libm
    os.environ.setdefault("NUMBA_DISABLE_INTEL_SVML", "1")


_fix_target()

import numba  # noqa: E402 - it reads the environment when it is imported
import numba.extending  # noqa: E402 - for the modules that get numba from here
from numba.core.caching import FunctionCache  # noqa: E402

__all__ = [
    "compiled",
    "is_missing_on_disk",
    "njit",
    "numba",
    "prange",
    "target_processor",
    "versions",
]

CODE_FOLDER = "code"
"""Folder of machine code, in the user's cache and in the package."""
BUILT_WITH = "built_with.json"
"""File of the package that tells what its machine code was compiled with."""


def compiled(**settings: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator that compiles a function at its first call and keeps its machine code.

    Where no folder can be written, every process compiles the function again.

    Division by zero gives infinity or not-a-number, as in numpy. An exception would need a branch at
    each division and increase the compilation time by a tenth.

    Args:
        settings: Further settings of `numba.njit`, e.g. `parallel=True`.
    """
    settings = {"error_model": "numpy", "nogil": True, **settings}

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        kernel = numba.njit(**settings)(function)
        if hasattr(kernel, "py_func"):  # not there where compilation is switched off
            kernel._cache = _KernelCache(kernel.py_func, settings)
        return kernel  # type: ignore[no-any-return]

    return decorate


def njit(*, cache: bool = True, **settings: Any) -> Callable[..., Any]:
    """Return `compiled(**settings)`; generated modules say `njit`."""
    assert cache
    return compiled(**settings)


def is_missing_on_disk(kernel: Callable[..., Any]) -> bool:
    """Tell whether the disk could hold the machine code of a compiled function but does not."""
    kept = getattr(kernel, "_cache", None)
    return isinstance(kept, _KernelCache) and not kept.has_entry()


class _KernelCache(FunctionCache):  # type: ignore[misc]
    """The machine code of one function on disk, a file for each set of argument types."""

    def __init__(self, function: FunctionType, settings: dict[str, Any]) -> None:
        self._function = function
        self._settings = settings
        self._enabled = bool(_source(function.__module__)) and function.__closure__ is None

    @property
    def cache_path(self) -> str:
        return str(cache_folder(CODE_FOLDER))

    def has_entry(self) -> bool:
        """Tell whether there is machine code of the function for some types."""
        pattern = self._stem() + "*.nbc"
        return any(any(folder.glob(pattern)) for folder in self._folders())

    def flush(self) -> None:
        for path in cache_folder(CODE_FOLDER).glob(self._stem() + "*.nbc"):
            path.unlink(missing_ok=True)

    def _load_overload(self, sig: Any, target_context: Any) -> Any:
        if not self._enabled:
            return None
        name = self._file_name(sig, target_context.codegen())
        for folder in self._folders():
            try:
                data = (folder / name).read_bytes()
            except OSError:
                continue
            result_type = numba.core.compiler.CompileResult
            return result_type._rebuild(target_context, *pickle.loads(data))
        if self._function.__module__.startswith("maplab_py"):
            _say_why_not_packaged()
        return None

    def _save_overload(self, sig: Any, data: Any) -> None:
        if not self._enabled or data.lifted or data.library.has_dynamic_globals:
            return
        parts = list(data._reduce())
        parts[6] = ""  # the annotated source, which nobody reads, with the path of its file
        path = cache_folder(CODE_FOLDER) / self._file_name(sig, data.codegen)
        write_file(path, [numba.core.serialize.dumps(tuple(parts))], durable=False)

    @staticmethod
    def _folders() -> Iterator[Path]:
        yield PACKAGED / CODE_FOLDER
        yield cache_folder(CODE_FOLDER)

    def _stem(self) -> str:
        module, name = self._function.__module__, self._function.__qualname__
        settings = sorted((key, _describe(value)) for key, value in self._settings.items())
        code = self._function.__code__  # differs from the file after a reload
        function = f"{name} {code.co_code.hex()} {_describe(code.co_consts)} {settings}"
        stamp = _digest(_source_digest(module), function)
        return f"{module.rpartition('.')[2]}.{name.replace('<', '').replace('>', '')}-{stamp}-"

    def _file_name(self, sig: Any, codegen: Any) -> str:
        target = _digest(repr(sig), repr(codegen.magic_tuple()), repr(versions()))
        return f"{self._stem()}{target}.nbc"


@cache
def versions() -> dict[str, str]:
    """Return by name the versions that machine code depends on."""
    return {
        "python": f"{sys.implementation.name} {sys.version_info[0]}.{sys.version_info[1]}",
        "numba": numba.__version__,
        "numpy": ".".join(np.__version__.split(".")[:2]),
    }


def built_with() -> dict[str, str]:
    """Return the versions and the processor that machine code is compiled with now."""
    return {**versions(), "processor": os.environ.get("NUMBA_CPU_NAME", "this one")}


@cache
def _say_why_not_packaged() -> None:
    """Tell once why the wheel's machine code is not used, if the reason is known."""
    try:
        built = json.loads((PACKAGED / BUILT_WITH).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return
    different = [
        f"{name} {built.get(name)}, not {value}"
        for name, value in built_with().items()
        if value not in built.get(name, "").split(", ")
    ]
    if different:
        kernel_cache.tell_user(
            f"the installed kernels were compiled with {'; '.join(different)}: compiling them again, "
            "once, when they are needed (maplab warmup compiles all)"
        )


@cache
def _source_digest(module: str) -> str:
    """Return a hash of the sources that decide what the kernels of a module are compiled to."""
    names = _modules_of_kernels(module, set())
    return _digest(*(part for name in sorted(names) for part in (name, _module_digest(name))))


def _modules_of_kernels(module: str, seen: set[str]) -> set[str]:
    """Return the names of a module and of those whose kernels and named tuples it refers to."""
    seen.add(module)
    for value in vars(sys.modules[module]).values():
        if isinstance(value, ModuleType):
            name = value.__name__ if _is_of_kernels(value) else module
        elif hasattr(value, "py_func"):
            name = value.py_func.__module__
        elif isinstance(value, type) and issubclass(value, tuple) and hasattr(value, "_fields"):
            name = value.__module__
        else:
            continue
        if name not in seen:
            _modules_of_kernels(name, seen)
    return seen


def _is_of_kernels(module: ModuleType) -> bool:
    return any(isinstance(getattr(x, "_cache", None), _KernelCache) for x in vars(module).values())


@cache
def _source(module: str) -> str:
    """Return a hash of a module's file as it is when its first kernel is declared; "" without a file."""
    file = getattr(sys.modules.get(module), "__file__", None)
    return hashlib.sha256(Path(file).read_bytes()).hexdigest() if file else ""


@cache
def _module_digest(module: str) -> str:
    names = {name: _describe(value) for name, value in vars(sys.modules[module]).items()}
    constants = sorted((k, v) for k, v in names.items() if v and not k.startswith("__"))
    return _digest(_source(module), repr(constants))


def _describe(value: Any) -> str:
    """Return the content of what numba takes for a constant, else nothing."""
    if isinstance(value, set | frozenset):
        return repr(sorted(map(_describe, value)))
    if isinstance(value, np.ndarray):
        return f"{value.dtype} {value.shape} {hashlib.sha256(value.tobytes()).hexdigest()}"
    if isinstance(value, tuple) and not hasattr(value, "_fields"):
        return repr([_describe(each) for each in value])
    if isinstance(value, bool | int | float | complex | str | enum.Enum | np.generic):
        return repr(value)
    if isinstance(value, type) and issubclass(value, enum.Enum):
        return repr(list(value))
    if isinstance(value, numba.types.ExternalFunction):
        return f"{value.symbol} {value.sig}"
    return ""


def _digest(*parts: str) -> str:
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:16]


prange: Any = numba.prange
