"""Files that are replaced as a whole."""

import contextlib
import hashlib
import os
import shutil
import stat
import threading
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import BinaryIO

from maplab_py.atomic.system import RENAMES_OPEN_FILES, flush_folder, opened_locked
from maplab_py.cancellation import check_cancelled, cleaned_up, lasting_effect
from maplab_py.errors import Cancelled, UserError

_SECONDS_TO_WAIT = 10.0
_SECONDS_BETWEEN_LOOKS = 0.02


class PendingFile:
    """New content of a file under a hidden name beside it, locked until published or discarded.

    The hidden name is given up once, by one thread: after that another writer may be using it.
    """

    def __init__(self, path: Path, *, durable: bool = True) -> None:
        """Create the parent folders and open the hidden file.

        Args:
            path: The file; a symbolic link is kept and its target is replaced.
            durable: Flush to disk, so that the content survives a power failure. Not needed for
                files that can be recreated.

        Raises:
            OSError: The file cannot be written.
            UserError: The path cannot be a file, or another program is writing it.
            Cancelled: The running command was cancelled while the other program was writing it.
        """
        self.target = resolved(path)  # the file, with symbolic links followed
        if self.target.is_dir():
            raise UserError(f"{path} is a folder: name a file")
        self._path, self._durable = path, durable
        self._temporary = sibling(self.target, "saving")
        self._name_lock = threading.Lock()
        self._has_name = True  # the hidden one
        self._made = make_folders(self.target.parent)
        try:
            # stream for the content
            self.stream: BinaryIO = os.fdopen(_claimed(self._temporary, self.target, path), "wb")
        except BaseException:
            remove_folders(self._made)
            raise

    def write(self, chunks: Iterable[bytes]) -> None:
        """Write the whole content.

        Raises:
            OSError: The file cannot be written.
            Cancelled: The running command has been cancelled.
        """
        for chunk in chunks:
            check_cancelled()
            self.stream.write(chunk)
        self.complete()

    def complete(self) -> None:
        """Flush the content to disk; only the rename is missing."""
        self.stream.flush()
        if self._durable:
            os.fsync(self.stream.fileno())
        if not RENAMES_OPEN_FILES:
            self.stream.close()

    def publish(self) -> None:
        """Rename the file to its final name.

        Raises:
            UserError: The file cannot be written; `discard` is still to be called.
            Cancelled: The running command was abandoned and the hidden file deleted.
        """
        try:
            with self._name_lock:
                if not self._has_name:
                    raise Cancelled("cancelled")
                os.replace(self._temporary, self.target)
                self._has_name = False
            folders = (self.target.parent, *(folder.parent for folder in self._made))
            for folder in folders if self._durable else ():
                flush_folder(folder)
        except OSError as error:
            raise UserError(f"{self._path}: cannot be written ({reason(error)})") from error

    def remove(self) -> None:
        """Delete the hidden file and the folders created for it, unless it has been published."""
        with self._name_lock:
            if not self._has_name:
                return
            with contextlib.suppress(OSError):
                os.unlink(self._temporary)
            self._has_name = False
        remove_folders(self._made)

    def discard(self) -> None:
        """Delete an unpublished file and release the lock."""
        self.remove()
        with contextlib.suppress(OSError):
            self.stream.close()


def write_file(path: Path, chunks: Iterable[bytes], *, durable: bool = True) -> None:
    """Write a file from pieces; see `replaced_file`."""
    with replaced_file(path, durable=durable) as stream:
        stream.writelines(chunks)


def link_or_copy(source: str | Path, target: str | Path) -> bool:
    """Give a file a second name; copy it where the file system refuses links.

    For files that are only ever replaced: a write into one would show under both names.

    Returns:
        Whether it is a link.

    Raises:
        OSError: It cannot be copied either.
    """
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)
        return False
    return True


@contextlib.contextmanager
def replaced_file(path: Path, *, durable: bool = True) -> Iterator[BinaryIO]:
    """Yield a stream; its content becomes the file's content at the end of the block.

    Parent folders are created. A symbolic link is kept and its target is replaced; the file keeps its
    permissions. After an exception, or if the running command has been cancelled, nothing has changed.

    Args:
        durable: Flush to disk, so that the content survives a power failure. Not needed for
            files that can be recreated, which do not count as an effect of a command either.

    Raises:
        UserError: It cannot be written, or another program is writing it.
    """
    try:
        pending = PendingFile(path, durable=durable)
        with cleaned_up(pending.remove):
            try:
                yield pending.stream
                pending.complete()
                with lasting_effect() if durable else contextlib.nullcontext():
                    pending.publish()
            finally:
                pending.discard()
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({reason(error)})") from error


def _claimed(temporary: Path, target: Path, path: Path) -> int:
    """Open the temporary file, empty and locked; it may be left from a process that was killed."""
    deadline = time.monotonic() + _SECONDS_TO_WAIT
    while (descriptor := opened_locked(temporary)) is None:
        check_cancelled()
        if time.monotonic() > deadline:
            raise UserError(f"{path}: another program is writing it; try again later")
        time.sleep(_SECONDS_BETWEEN_LOOKS)
    try:
        os.ftruncate(descriptor, 0)
        _copy_permissions(target, descriptor)
    except OSError:
        with contextlib.suppress(OSError):
            os.unlink(temporary)
        os.close(descriptor)
        raise
    return descriptor


def _copy_permissions(target: Path, descriptor: int) -> None:
    """Give the new file the permissions of the one that it replaces, before it has content."""
    try:
        mode = stat.S_IMODE(os.stat(target).st_mode)
    except FileNotFoundError:
        return
    if hasattr(os, "fchmod"):
        with contextlib.suppress(PermissionError):  # file systems without permissions
            os.fchmod(descriptor, mode)


# Targets of writes: symbolic links resolved, devices refused, names of the hidden siblings.

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
