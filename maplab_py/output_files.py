"""Files that commands write: complete or not at all, and never in place of others unasked.

Inside `planning()` nothing reaches the disk: everything is checked and made as ever, and what would
have been written is noted instead. That is how commands that write files are tried (--dry_run).
"""

from __future__ import annotations

import dataclasses
import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

from maplab_py.errors import UserError


@dataclasses.dataclass(frozen=True)
class PlannedFile:
    """A file that would be written."""

    path: Path
    size_bytes: int
    replaces: bool

    def __str__(self) -> str:
        """Say what would happen, in a few words."""
        verb = "replace" if self.replaces else "write"
        return f"would {verb} {self.path} ({self.size_bytes:,} bytes)"


_planned: ContextVar[list[PlannedFile] | None] = ContextVar("planned", default=None)


@contextmanager
def planning() -> Iterator[list[PlannedFile]]:
    """Note files instead of writing them, in this thread; gives the list of what was noted."""
    noted: list[PlannedFile] = []
    token = _planned.set(noted)
    try:
        yield noted
    finally:
        _planned.reset(token)


def check_writable(path: Path, *, overwrite: bool) -> None:
    """Refuse a file that exists, before any work is done.

    Raises:
        UserError: The file exists and `overwrite` is not set, or it is a folder.
    """
    if path.is_dir():
        raise UserError(f"{path} is a folder: name a file")
    if path.exists() and not overwrite:
        raise UserError(f"{path} exists already: give --overwrite to replace it")


def write_text(path: Path, chunks: Iterable[str], *, overwrite: bool = False) -> None:
    """Write a text file (UTF-8, lines end as they are given) at once; see `write_bytes`."""
    write_bytes(path, (chunk.encode() for chunk in chunks), overwrite=overwrite)


def write_bytes(path: Path, chunks: Iterable[bytes], *, overwrite: bool = False) -> None:
    """Write a file at once: it is either there completely or not at all. Folders are made.

    Raises:
        UserError: The file exists and `overwrite` is not set, or it cannot be written.
    """
    check_writable(path, overwrite=overwrite)
    noted = _planned.get()
    if noted is not None:
        size_bytes = sum(len(chunk) for chunk in chunks)
        noted.append(PlannedFile(path, size_bytes, path.exists()))
        return
    temporary = ""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
        with os.fdopen(handle, "wb") as stream:
            stream.writelines(chunks)
            stream.flush()
            os.fsync(stream.fileno())
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, path)
        temporary = ""
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}") from error
    finally:
        if temporary:
            Path(temporary).unlink(missing_ok=True)


def _umask() -> int:
    current = os.umask(0)
    os.umask(current)
    return current
