"""The user's cache folder. Code in it is executed, so only the user may write to it."""

import atexit
import logging
import os
import shutil
import stat
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from maplab_py.errors import UserError

VARIABLE = "MAPLAB_CACHE_DIR"
PACKAGED = Path(__file__).resolve().parent / "_kernels"
"""Kernels that the wheel brings; trusted as the package is, and never written at run time."""

tell_user: Callable[[str], None] = logging.getLogger(__name__).warning
"""Prints a line for the user; the console replaces it."""

is_compiling = threading.Event()
"""Set while a kernel is compiled."""
_seconds = [0.0]


def seconds() -> float:
    """Return the time in which this process compiled and loaded kernels so far [s]."""
    return _seconds[0]


@contextmanager
def compilation() -> Iterator[None]:
    """Count the time inside as that of compilation."""
    begin = time.perf_counter()
    try:
        yield
    finally:
        _seconds[0] += time.perf_counter() - begin
        is_compiling.clear()


def cache_root() -> Path:
    """Return the folder that MAPLAB_CACHE_DIR names, else one in the user's cache directory."""
    base = Path(os.environ.get("XDG_CACHE_HOME", "") or Path.home() / ".cache")
    return Path(os.environ.get(VARIABLE, "") or base / "maplab_py")


@cache
def cache_folder(name: str) -> Path:
    """Return a folder of the cache that can be written; it is made if needed.

    If that is not possible, the folder's content is copied to a temporary one, which this process
    and its child processes use and which is deleted at exit.

    Raises:
        UserError: Other users own the cache or may write to it.
    """
    root, folder = cache_root(), cache_root() / name
    for existing in (root, folder):
        check_trusted(existing)
    try:
        root.parent.mkdir(parents=True, exist_ok=True)
        for each in (root, folder):
            each.mkdir(mode=0o700, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError as error:
        tell_user(
            f"{folder}: the cache of compiled kernels cannot be written ({error.strerror}); kernels "
            f"compiled now are used in this run only (name another folder by {VARIABLE})"
        )
    temporary = Path(tempfile.mkdtemp(prefix="maplab-kernels-"))
    atexit.register(shutil.rmtree, temporary, ignore_errors=True)
    os.environ[VARIABLE] = str(temporary)
    try:
        shutil.copytree(folder, temporary / name)
    except (OSError, shutil.Error):  # what cannot be copied is compiled again
        (temporary / name).mkdir(exist_ok=True)
    return temporary / name


def check_trusted(
    path: Path, content: str = "compiled code", danger: str = "code in it would be run"
) -> None:
    """Refuse to use a file or folder, if it exists, that other users own or may write to.

    Args:
        path: The file or folder.
        content: Content of the cache, for the message.
        danger: Consequence of using it, for the message.

    Raises:
        UserError: Other users own it or may write to it.
    """
    if not (hasattr(os, "geteuid") and path.exists()):
        return
    status = path.stat()
    if status.st_uid not in (os.geteuid(), 0):
        reason = "belongs to another user"
    elif status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        reason = "can be written by other users"
    else:
        return
    raise UserError(
        f"{path}: the cache of {content} {reason}, and {danger}: "
        f"remove their write permission (chmod go-w), or name another folder by {VARIABLE}"
    )
