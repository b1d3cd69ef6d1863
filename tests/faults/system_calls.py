"""Python's system calls that change files, counted; the n-th fails, or the process ends there.

Patches the functions of `os`, `io`, `fcntl` and `ctypes` in this process for good: to be installed
in a forked child only. Counted are calls below one folder, in the order of the program, so that the
same n is the same call in every run.
"""

import builtins
import contextlib
import ctypes
import dataclasses
import errno
import fcntl
import functools
import io
import os
import shutil
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any

KILLED = 77
SPACE_CALLS = ("open", "write", "fsync", "mkdir", "link", "symlink", "rename", "ftruncate")
"""Calls that a full disk refuses; deleting goes on."""
PATH_CALLS = ("open", "mkdir", "link", "symlink", "rename", "unlink", "rmdir", "fchmod")
"""Calls that missing permissions refuse."""


@dataclasses.dataclass(frozen=True)
class Fault:
    """What happens at the n-th call (1 = the first; 0 = nothing ever)."""

    kind: str  # kill, power (kill, and what was not flushed is lost), error, full
    at: int
    code: int = errno.EIO
    has_renameat2: bool = True


class SystemCalls:
    """The patched functions, what they have seen, and the fault."""

    def __init__(self, folder: Path, fault: Fault) -> None:
        self.folder, self.fault = str(folder), fault
        self.names: list[str] = []
        self.has_struck = False
        self.paths: dict[int, str] = {}  # by descriptor
        self.dirty: dict[tuple[int, int], int] = {}  # descriptors of files with unflushed content
        self.new_names: dict[tuple[int, int], tuple[int, set[str]]] = {}  # unflushed, by folder
        self.renamed_in: set[tuple[int, int]] = set()  # folders with unflushed renames
        self.real = {name: getattr(os, name) for name in _PATCHED}
        self.real_open = io.open
        self.real_file_close = io.FileIO.close
        self.real_file_write = io.FileIO.write

    # -- the fault ------------------------------------------------------------------------------

    def point(self, name: str, path: str, before_kill: Callable[[], object] = lambda: None) -> None:
        """Count a call; strike if it is the one."""
        self.names.append(f"{name} {os.path.relpath(path, self.folder)}")
        count, fault = len(self.names), self.fault
        is_full = fault.kind == "full" and fault.at and count >= fault.at and name in SPACE_CALLS
        if not is_full and (count != fault.at or fault.kind == "full"):
            return
        self.has_struck = True
        if fault.kind in ("error", "full"):
            code = errno.ENOSPC if fault.kind == "full" else fault.code
            raise OSError(code, os.strerror(code), path)
        before_kill()
        if fault.kind == "power":
            self.lose_power()
        os._exit(KILLED)

    def lose_power(self) -> None:
        """Throw away what has not been flushed: contents of files, and names in folders."""
        for descriptor in self.dirty.values():
            self.real["ftruncate"](descriptor, 0)
        for descriptor, names in self.new_names.values():
            for name in names:
                place = f"/proc/self/fd/{descriptor}/{name}"
                with contextlib.suppress(FileNotFoundError):
                    if stat.S_ISDIR(os.lstat(place).st_mode):
                        _remove_tree(place, self.real)
                    else:
                        self.real["unlink"](place)

    # -- bookkeeping ----------------------------------------------------------------------------

    def below(self, path: Any, dir_fd: int | None = None) -> str:
        """Return the absolute path of a watched file or folder, an empty text for any other."""
        if isinstance(path, int):
            return self.paths.get(path, "")
        text = os.fsdecode(path)
        if dir_fd is not None:
            if dir_fd not in self.paths:
                return ""
            text = os.path.join(self.paths[dir_fd], text)
        text = os.path.abspath(text)
        return text if text.startswith(self.folder + os.sep) or text == self.folder else ""

    def note_name(self, path: str) -> None:
        """Remember that a name has come into a folder."""
        parent, name = os.path.split(path)
        descriptor = self.real["open"](parent, os.O_RDONLY | os.O_DIRECTORY)
        key = _identity(descriptor)
        self.new_names.setdefault(key, (descriptor, set()))[1].add(name)

    def note_rename(self, *paths: str) -> None:
        for path in paths:
            parent, name = os.path.split(path)
            status = os.stat(parent)
            key = status.st_dev, status.st_ino
            self.renamed_in.add(key)
            if key in self.new_names:
                self.new_names[key][1].discard(name)

    def note_write(self, descriptor: int) -> None:
        key = _identity(descriptor)
        if key not in self.dirty:
            place = f"/proc/self/fd/{descriptor}"
            self.dirty[key] = self.real["open"](place, os.O_WRONLY)

    def note_flush(self, descriptor: int) -> None:
        key = _identity(descriptor)
        self.dirty.pop(key, None)
        self.new_names.pop(key, None)
        self.renamed_in.discard(key)

    # -- the patched functions ------------------------------------------------------------------

    def install(self) -> None:
        """Patch this process."""
        for name in _ONE_PATH:
            setattr(os, name, self._one_path(name))
        for name in ("rename", "replace", "link", "symlink"):
            setattr(os, name, self._two_paths(name))
        for name in ("write", "fsync", "close", "ftruncate", "fchmod"):
            setattr(os, name, self._of_descriptor(name))
        os.open = self._open
        os.sendfile = self._sendfile
        io.open = builtins.open = self._file  # type: ignore[assignment]
        fcntl.flock = self._flock
        ctypes.CDLL = functools.partial(_Library, self, ctypes.CDLL)  # type: ignore[misc, assignment]

    def _open(self, path: Any, flags: int, mode: int = 0o777, *, dir_fd: int | None = None) -> int:
        watched = self.below(path, dir_fd)
        is_new = bool(watched and flags & os.O_CREAT and not os.path.lexists(watched))
        if watched:
            self.point("open" if is_new else "open_old", watched)
        descriptor: int = self.real["open"](path, flags, mode, dir_fd=dir_fd)
        if watched:
            self.paths[descriptor] = watched
        if is_new:
            self.note_name(watched)
        return descriptor

    def _file(
        self, file: Any, mode: str = "r", buffering: int = -1, *args: Any, **keys: Any
    ) -> Any:
        watched = self.below(file)
        if not watched or not set(mode) & set("wax+"):
            if watched:
                self.point("open_old", watched)
            return self.real_open(file, mode, buffering, *args, **keys)
        is_new = not isinstance(file, int) and not os.path.lexists(watched)
        if not isinstance(file, int):
            self.point("open" if is_new else "open_old", watched)
        raw = _File(self, watched, file, mode.replace("b", "").replace("t", ""))
        self.paths[raw.fileno()] = watched
        if is_new:
            self.note_name(watched)
        stream: Any = io.BufferedRandom(raw) if "+" in mode else io.BufferedWriter(raw)
        if "b" in mode:
            return stream
        return io.TextIOWrapper(stream, *args, **keys)

    def _sendfile(self, out: int, source: int, offset: Any, count: int) -> int:
        watched = self.below(out)
        if watched:
            self.point("write", watched)
            self.note_write(out)
        sent: int = os_sendfile(out, source, offset, count)
        return sent

    def _one_path(self, name: str) -> Callable[..., Any]:
        def call(path: Any, *args: Any, **keys: Any) -> Any:
            watched = self.below(path, keys.get("dir_fd"))
            if watched:
                self.point("unlink" if name == "remove" else name, watched)
            result = self.real[name](path, *args, **keys)
            if watched and name == "mkdir":
                self.note_name(watched)
            return result

        return call

    def _two_paths(self, name: str) -> Callable[..., Any]:
        def call(source: Any, target: Any, *args: Any, **keys: Any) -> Any:
            watched = self.below(target)
            if watched:
                self.point("rename" if name == "replace" else name, watched)
            result = self.real[name](source, target, *args, **keys)
            if watched and name in ("link", "symlink"):
                self.note_name(watched)
            elif watched:
                self.note_rename(os.path.abspath(source), watched)
            return result

        return call

    def _of_descriptor(self, name: str) -> Callable[..., Any]:
        def call(descriptor: int, *args: Any) -> Any:
            watched = self.below(descriptor)
            if not watched:
                return self.real[name](descriptor, *args)
            if name == "close":
                self.paths.pop(descriptor)
                self.real[name](descriptor)
                self.point(name, watched)
                return None
            self.point(name, watched)
            if name == "write":
                self.note_write(descriptor)
            result = self.real[name](descriptor, *args)
            if name == "fsync":
                self.note_flush(descriptor)
            return result

        return call

    def _flock(self, descriptor: Any, operation: int) -> None:
        watched = self.below(descriptor) if isinstance(descriptor, int) else ""
        if watched:
            self.point("flock", watched)
        fcntl_flock(descriptor, operation)


class _File(io.FileIO):
    """A file whose writes and whose end are counted; a kill leaves half of the last write."""

    def __init__(self, calls: SystemCalls, path: str, file: Any, mode: str) -> None:
        self._calls, self._path = calls, path
        super().__init__(file, mode)

    def write(self, data: Any) -> int:
        view = memoryview(data).cast("B")
        self._calls.note_write(self.fileno())
        half = view[: len(view) // 2]
        self._calls.point("write", self._path, lambda: self._calls.real_file_write(self, half))
        return self._calls.real_file_write(self, view)

    def close(self) -> None:
        if self.closed:
            return
        self._calls.paths.pop(self.fileno(), None)
        self._calls.real_file_close(self)
        self._calls.point("close", self._path)


class _Library:
    """The C library, of which only renameat2 is counted."""

    def __init__(self, calls: SystemCalls, load: Any, name: Any, *args: Any, **keys: Any) -> None:
        self._calls, self._library = calls, load(name, *args, **keys)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._library, name)

    def renameat2(self, *args: Any) -> int:
        paths = [os.fsdecode(args[1]), os.fsdecode(args[3])]
        if not self._calls.fault.has_renameat2:
            ctypes.set_errno(errno.ENOSYS)
            return -1
        try:
            self._calls.point("rename", paths[1])
        except OSError as error:
            ctypes.set_errno(error.errno or errno.EIO)
            return -1
        status: int = self._library.renameat2(*args)
        if status == 0:
            self._calls.note_rename(*paths)
        return status


_ONE_PATH = ("mkdir", "unlink", "remove", "rmdir", "chmod", "utime", "truncate")
_PATCHED = (*_ONE_PATH, "rename", "replace", "link", "symlink", "write", "fsync", "close",
            "ftruncate", "fchmod", "open")  # fmt: skip
os_sendfile = os.sendfile
fcntl_flock = fcntl.flock


def _identity(descriptor: int) -> tuple[int, int]:
    status = os.fstat(descriptor)
    return status.st_dev, status.st_ino


def _remove_tree(place: str, real: dict[str, Any]) -> None:
    for name, value in real.items():
        setattr(os, name, value)
    shutil.rmtree(place)
