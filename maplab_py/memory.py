"""Available memory, and the refusal of work that does not fit before it begins.

Linux overcommits memory and kills the process when it runs out. Therefore large allocations are
announced by `require_memory` beforehand.
"""

import contextlib
import gc
import re
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path

from maplab_py.errors import UserError

_GB = 1e9
_NEGLIGIBLE = 1e7
"""Bytes that are not refused without a limit: to ask what is available takes half a millisecond."""
_SHARE = 0.9
"""Fraction of the available memory that one command may take."""
_GLOBAL_FLAG = "--max_memory_gb"
_NOT_ENOUGH = re.compile(r"needs [0-9.]+ GB of memory|there is not enough memory")
_limit_bytes: ContextVar[float | None] = ContextVar("memory limit", default=None)
_limit_source: ContextVar[str] = ContextVar("what limits the memory", default=_GLOBAL_FLAG)
_bytes_before: ContextVar[float] = ContextVar("memory of the process before", default=0.0)


class NotEnoughMemory(UserError):
    """The work needs more memory than is available."""


@contextlib.contextmanager
def memory_limited(limit_gb: float, flag: str = _GLOBAL_FLAG) -> Iterator[None]:
    """Limit the memory [GB] of work inside the block, in this thread; 0 = keep the present limit.

    Without a limit it may take most of the available memory. Messages name the flag.
    """
    if limit_gb <= 0.0:
        yield
        return
    tokens = _limit_bytes.set(limit_gb * _GB), _limit_source.set(flag)
    before = _bytes_before.set(resident_bytes())
    try:
        yield
    finally:
        _limit_bytes.reset(tokens[0])
        _limit_source.reset(tokens[1])
        _bytes_before.reset(before)


@contextlib.contextmanager
def memory_limited_to_share(share: float, flag: str) -> Iterator[None]:
    """Limit the memory of work inside the block to a part of what is available.

    Where there is a limit already, that one holds. Messages name the flag that allows more.
    """
    is_limited = _limit_bytes.get() is not None
    with memory_limited(0.0 if is_limited else share * available_bytes() / _GB, flag):
        yield


def require_memory(needed_bytes: float, purpose: str) -> None:
    """Refuse work that exceeds the allowed memory.

    What the process has allocated since the limit was set counts, too.

    Args:
        needed_bytes: Bytes still to be allocated.
        purpose: Subject of the message.

    Raises:
        NotEnoughMemory: The work does not fit.
    """
    limit = _limit_bytes.get()
    if limit is None and needed_bytes < _NEGLIGIBLE:
        return
    allowed = _SHARE * available_bytes() if limit is None else limit
    used = 0.0 if limit is None else max(0.0, resident_bytes() - _bytes_before.get())
    if needed_bytes + used <= allowed:
        return
    flag = _limit_source.get()
    beside = f" beside {used / _GB:.2f} GB in use" if used > 0.005 * _GB else ""
    source = "are available" if limit is None else f"are allowed by {flag}"
    raise NotEnoughMemory(
        f"{purpose} needs {needed_bytes / _GB:.2f} GB of memory{beside}, {allowed / _GB:.2f} GB {source}: "
        "sparsify the map (kfh, landmark_sparsify), choose fewer missions (--map_mission_list), or "
        f"allow more by {flag}"
    )


def available_bytes() -> float:
    """Return the memory that the machine, the control group and the process limits still allow."""
    return max(0.0, min(_machine_bytes(), _control_group_bytes(), _limits_bytes()))


def resident_bytes(process: int | str = "self") -> float:
    """Return the memory that a process holds; 0 where the system does not tell."""
    size = _kilobytes(Path(f"/proc/{process}/status"), "VmRSS:")
    return size if size < float("inf") else 0.0


def says_not_enough(message: str) -> bool:
    """Tell whether an error of a command, in another process, is one of too little memory."""
    return bool(_NOT_ENOUGH.search(message))


def _machine_bytes() -> float:
    return _kilobytes(Path("/proc/meminfo"), "MemAvailable:")


def _control_group_bytes() -> float:
    """Return what the control groups allow (Linux, version 2 and 1); infinite where there are none."""
    left = float("inf")
    try:
        lines = Path("/proc/self/cgroup").read_text().splitlines()
    except OSError:
        return left
    root = Path("/sys/fs/cgroup")
    for line in lines:
        _, controllers, path = line.split(":", 2)
        inner = path.lstrip("/")
        if not controllers:
            base, names = root, ("memory.max", "memory.current")
        elif "memory" in controllers.split(","):
            base, names = root / "memory", ("memory.limit_in_bytes", "memory.usage_in_bytes")
        else:
            continue
        # limits of all groups around this one hold too; in a container the root is the own group
        for folder in (base / inner, *(base / inner).parents):
            left = min(left, _left_in_group(folder, *names))
            if folder == base:
                break
    return left


def _left_in_group(folder: Path, limit: str, usage: str) -> float:
    try:
        text = (folder / limit).read_text().strip()
        if text == "max":
            return float("inf")
        used = float((folder / usage).read_text())
        # files that are only cached are given back
        used -= _statistic(folder / "memory.stat", ("inactive_file", "total_inactive_file"))
        return float(text) - used
    except (OSError, ValueError):
        return float("inf")


def _statistic(path: Path, names: tuple[str, ...]) -> float:
    for line in path.read_text().splitlines():
        name, _, value = line.partition(" ")
        if name in names:
            return float(value)
    return 0.0


def _limits_bytes() -> float:
    """Return what the limits on this process's address space and data leave."""
    try:
        import resource
    except ImportError:  # not a POSIX system
        return float("inf")
    left = float("inf")
    for limit, used in ((resource.RLIMIT_AS, "VmSize:"), (resource.RLIMIT_DATA, "VmData:")):
        soft, _ = resource.getrlimit(limit)
        if soft != resource.RLIM_INFINITY:
            size = _kilobytes(Path("/proc/self/status"), used)
            left = min(left, soft - (size if size < float("inf") else 0.0))
    return left


def _kilobytes(path: Path, name: str) -> float:
    """Return the bytes that a line `name 123 kB` says; infinite where there is none."""
    try:
        for line in path.read_text().splitlines():
            if line.startswith(name):
                return float(line.split()[1]) * 1024.0
    except OSError:
        pass
    return float("inf")


@contextlib.contextmanager
def collection_paused() -> Iterator[None]:
    """Pause the collection of garbage, for work that makes very many objects and no reference cycles."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()
