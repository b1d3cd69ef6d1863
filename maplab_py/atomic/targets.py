"""Targets of writes: symbolic links resolved, devices refused, names of the hidden siblings."""

from __future__ import annotations

import contextlib
import hashlib
import os
import stat
from pathlib import Path

from maplab_py.errors import UserError

_MAX_NAME_BYTES = 200
"""Longer names are hashed, so that the hidden names stay below the usual limit of 255 bytes."""


def resolved(path: Path) -> Path:
    """Return the absolute path that a write goes to, with all symbolic links followed.

    Raises:
        UserError: It is a device, a socket or a pipe, or the links lead in a circle.
    """
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:
        mode = 0
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({reason(error)})") from error
    if mode and not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise UserError(f"{path} is neither a file nor a folder; name a file or folder")
    return Path(os.path.realpath(path))


def sibling(target: Path, purpose: str) -> Path:
    """Return the hidden name beside a target that serves one purpose of its writer."""
    stem = os.fsencode(target.name)
    if len(stem) > _MAX_NAME_BYTES:
        stem = hashlib.sha256(stem).hexdigest()[:32].encode()
    return target.parent / f".{os.fsdecode(stem)}.{purpose}"


def make_folders(folder: Path) -> list[Path]:
    """Make a folder with its parents; return those that did not exist, the outermost first."""
    missing = [folder] if not folder.is_dir() else []
    while missing and not missing[-1].parent.is_dir():
        missing.append(missing[-1].parent)
    made: list[Path] = []
    try:
        for path in reversed(missing):
            with contextlib.suppress(FileExistsError):
                path.mkdir()
                made.append(path)
    except OSError:
        remove_folders(made)
        raise
    return made


def remove_folders(made: list[Path]) -> None:
    """Remove the folders that `make_folders` made, as far as they are empty."""
    for path in reversed(made):
        with contextlib.suppress(OSError):
            path.rmdir()


def reason(error: OSError) -> str:
    """Return the cause of an error in words."""
    return error.strerror or str(error)
