"""Output files of commands: written completely or not at all, and replaced only on request.

Inside `planning()` nothing is written: everything is checked and computed as usual, and the files
are recorded instead. --dry_run uses this. Inside `staging()` files are written under temporary
names and published together: a command that fails or is cancelled leaves no files.
"""

import dataclasses
import functools
import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

from maplab_py.atomic import PendingFile, files, replaced_file
from maplab_py.cancellation import cleaned_up
from maplab_py.errors import UserError

_CHUNK_BYTES = 1 << 20


@dataclasses.dataclass(frozen=True)
class PlannedFile:
    """A file that would be written."""

    path: Path
    size_bytes: int
    replaces: bool

    def __str__(self) -> str:
        verb = "replace" if self.replaces else "write"
        return f"would {verb} {self.path} ({self.size_bytes:,} bytes)"


_planned: ContextVar[list[PlannedFile] | None] = ContextVar("planned", default=None)


@contextmanager
def planning() -> Iterator[list[PlannedFile]]:
    """Record files instead of writing them, in this thread; yields the list of planned files."""
    noted: list[PlannedFile] = []
    token = _planned.set(noted)
    try:
        yield noted
    finally:
        _planned.reset(token)


class StagedFiles:
    """Complete files under temporary names that are published together."""

    def __init__(self) -> None:
        self.files: list[PendingFile] = []

    def add(self, path: Path, chunks: Iterable[bytes]) -> None:
        """Write a file under a temporary name; one that fails leaves nothing to be published.

        Raises:
            UserError: It cannot be written.
            Cancelled: The running command has been cancelled.
        """
        target = files.resolved(path)
        for earlier in [pending for pending in self.files if pending.target == target]:
            self.files.remove(earlier)
            earlier.discard()
        try:
            pending = PendingFile(path)
            self.files.append(pending)
            try:
                pending.write(chunks)
            except BaseException:
                self.files.remove(pending)
                pending.discard()
                raise
        except OSError as error:
            raise UserError(f"{path}: cannot be written ({files.reason(error)})") from error

    def publish(self) -> None:
        """Rename all files to their final names.

        Raises:
            UserError: One of them cannot be renamed; earlier ones have been published.
        """
        while self.files:
            self.files[0].publish()
            self.files.pop(0).discard()

    def remove(self) -> None:
        """Delete the unpublished files and the folders that were created for them."""
        for pending in reversed(self.files):
            pending.remove()

    def discard(self) -> None:
        """Delete the unpublished files and release their locks."""
        for pending in reversed(self.files):
            pending.discard()
        self.files.clear()


_staged: ContextVar[StagedFiles | None] = ContextVar("staged", default=None)


@contextmanager
def staging(*, enabled: bool = True) -> Iterator[StagedFiles]:
    """Keep the files that this thread writes under temporary names until `publish` is called.

    Unpublished files are deleted at the end of the block, or when the running command is abandoned.

    Args:
        enabled: If False, each file is published immediately.
    """
    staged = StagedFiles()
    token = _staged.set(staged if enabled else None)
    try:
        with cleaned_up(staged.remove):
            yield staged
    finally:
        staged.discard()
        _staged.reset(token)


def check_creatable(path: Path) -> None:
    """Refuse a file or folder that cannot be made, although folders above it are made.

    Raises:
        UserError: A folder above it is a file, or the user must not write into it.
    """
    above = next(folder for folder in path.absolute().parents if os.path.lexists(folder))
    if not os.path.isdir(above):
        raise UserError(f"{path}: cannot be written ({above} is not a folder)")
    if not os.access(above, os.W_OK | os.X_OK):
        raise UserError(f"{path}: cannot be written (no permission to write into {above})")


def check_writable(*paths: Path | None, overwrite: bool) -> None:
    """Refuse files that exist, before any work is done; None is no file.

    Raises:
        UserError: A file exists and `overwrite` is not set, it is a folder, a device, a socket
            or a pipe, or no file can be made there.
    """
    for path in filter(None, paths):
        try:
            mode = path.stat().st_mode
        except (FileNotFoundError, NotADirectoryError):
            check_creatable(path)
            continue
        except OSError as error:
            raise UserError(f"{path}: cannot be written ({error.strerror})") from error
        if stat.S_ISDIR(mode):
            raise UserError(f"{path} is a folder: name a file")
        if not stat.S_ISREG(mode):
            raise UserError(f"{path} is neither a file nor a folder: name a file")
        if not overwrite:
            raise UserError(f"{path} exists already: give --overwrite to replace it")


def copy_file(source: Path, target: Path, *, overwrite: bool = False) -> None:
    """Write the content of another file, as one that a library has made; raises UserError."""
    with source.open("rb") as stream:
        chunks = iter(functools.partial(stream.read, _CHUNK_BYTES), b"")
        write_bytes(target, chunks, overwrite=overwrite)


def write_text(path: Path, chunks: Iterable[str], *, overwrite: bool = False) -> None:
    """Write a text file (UTF-8, lines end as they are given) at once; see `write_bytes`."""
    write_bytes(path, (chunk.encode() for chunk in chunks), overwrite=overwrite)


def write_bytes(path: Path, chunks: Iterable[bytes], *, overwrite: bool = False) -> None:
    """Write a file at once: completely or not at all. Folders are created.

    A symbolic link stays; the file that it names is written.

    Raises:
        UserError: The file exists and `overwrite` is not set, or it cannot be written.
    """
    check_writable(path, overwrite=overwrite)
    noted = _planned.get()
    if noted is not None:
        size_bytes = sum(len(chunk) for chunk in chunks)
        noted.append(PlannedFile(path, size_bytes, path.exists()))
        return
    staged = _staged.get()
    if staged is not None:
        staged.add(path, chunks)
        return
    with replaced_file(path) as stream:
        stream.writelines(chunks)
