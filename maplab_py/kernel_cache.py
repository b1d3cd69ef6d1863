"""The folder of compiled kernels. Its code is executed, so only the user may write to it.

If it is not writable, its content is copied to a temporary folder, which this process and its child
processes use and which is deleted at exit.
"""

from __future__ import annotations

import atexit
import logging
import os
import shutil
import stat
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

from maplab_py.errors import UserError

VARIABLE = "MAPLAB_CACHE_DIR"
PACKAGED = Path(__file__).resolve().parent / "_kernels"
"""Kernels that the wheel brings; trusted as the package is, and never written at run time."""

_OTHERS_MAY_WRITE = stat.S_IWGRP | stat.S_IWOTH
_logger = logging.getLogger(__name__)

tell_user: Callable[[str], None] = _logger.warning
"""Prints a line for the user; the console replaces it."""


def cache_root() -> Path:
    """Return the folder that MAPLAB_CACHE_DIR names, else one in the user's cache directory."""
    configured = os.environ.get(VARIABLE, "")
    base = os.environ.get("XDG_CACHE_HOME", "") or str(Path.home() / ".cache")
    return Path(configured) if configured else Path(base) / "maplab_py"


@cache
def cache_folder(name: str) -> Path:
    """Return a folder of the cache that can be written.

    Args:
        name: Name of the folder in the cache.

    Raises:
        UserError: Other users own the cache or may write to it.
    """
    root = cache_root()
    folder = root / name
    for existing in (root, folder):
        check_trusted(existing, VARIABLE)
    try:
        root.parent.mkdir(parents=True, exist_ok=True)
        for each in (root, folder):
            each.mkdir(mode=0o700, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        return _temporary(folder, error)
    return folder


def check_trusted(
    folder: Path,
    variable: str,
    content: str = "compiled code",
    danger: str = "code in it would be run",
) -> None:
    """Refuse to load code or other content from a place that other users own or may write to.

    Args:
        folder: The folder, or a file; it need not exist.
        variable: Environment variable that names another folder.
        content: What is kept there, for the message.
        danger: What would happen, for the message.

    Raises:
        UserError: Other users own the folder or may write to it.
    """
    try:
        status = folder.stat()
    except OSError:
        return
    if not hasattr(os, "geteuid"):
        return
    if status.st_uid not in (os.geteuid(), 0):
        reason = "belongs to another user"
    elif status.st_mode & _OTHERS_MAY_WRITE:
        reason = "can be written by other users"
    else:
        return
    raise UserError(
        f"{folder}: the cache of {content} {reason}, and {danger}: "
        f"remove their write permission (chmod go-w), or name another folder by {variable}"
    )


def _temporary(folder: Path, error: OSError) -> Path:
    """Return a copy of a folder that cannot be written; it is deleted at the end of the process."""
    root = Path(tempfile.mkdtemp(prefix="maplab-kernels-"))
    atexit.register(shutil.rmtree, root, ignore_errors=True)
    copy = root / folder.name
    try:
        shutil.copytree(folder, copy)
    except (OSError, shutil.Error):
        shutil.rmtree(copy, ignore_errors=True)
        copy.mkdir()
    os.environ[VARIABLE] = str(root)  # processes that this one starts share it
    tell_user(
        f"{folder}: the cache of compiled kernels cannot be written ({error.strerror}); kernels "
        f"compiled now are used in this run only (name another folder by {VARIABLE})"
    )
    return copy
