"""Replace a folder as a whole: whoever looks, and whenever the program dies, old or new is there.

The new content is written to a hidden sibling and flushed to disk. Where the system can exchange
two names in one step (Linux, renameat2), that is the swap; elsewhere the old folder is first moved
aside, and `recover` moves it back if the program died between the two renames.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

from maplab_py.errors import UserError

_RENAME_EXCHANGE = 2
_AT_FDCWD = -100


@contextlib.contextmanager
def replaced_folder(folder: Path) -> Iterator[Path]:
    """Give a temporary folder to fill; it takes the place of `folder` when the block ends.

    After an exception the temporary folder is deleted and nothing has changed.

    Raises:
        UserError: Another program is saving to the same folder, or the disk refuses.
    """
    folder = Path(folder).absolute()
    folder.parent.mkdir(parents=True, exist_ok=True)
    with _lock(folder):
        recover(folder)
        temporary = folder.parent / f".{folder.name}.saving-{os.getpid()}"
        shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir()
        try:
            yield temporary
            _flush(temporary)
            _swap(temporary, folder)
        except OSError as error:
            raise UserError(f"{folder}: cannot be saved ({error.strerror})") from error
        finally:
            shutil.rmtree(temporary, ignore_errors=True)


def recover(folder: Path) -> None:
    """Finish what a killed program left: move the old folder back, delete half-written ones."""
    folder = Path(folder).absolute()
    aside = _aside(folder)
    if aside.is_dir():
        if folder.exists():
            shutil.rmtree(aside, ignore_errors=True)
        else:
            with contextlib.suppress(OSError):
                aside.rename(folder)
    prefix = f".{folder.name}.saving-"
    if not folder.parent.is_dir():
        return
    for path in folder.parent.glob(f"{prefix}*"):
        if not _is_running(path.name.removeprefix(prefix)):
            shutil.rmtree(path, ignore_errors=True)


def _swap(new: Path, folder: Path) -> None:
    if not folder.exists():
        new.rename(folder)
    elif not _exchanged(new, folder):
        aside = _aside(folder)
        folder.rename(aside)
        new.rename(folder)
        shutil.rmtree(aside, ignore_errors=True)
    _flush_folder(folder.parent)


def _exchanged(a: Path, b: Path) -> bool:
    """Exchange two names in one step; False where the system cannot."""
    if not sys.platform.startswith("linux"):
        return False
    library = ctypes.CDLL(None, use_errno=True)
    if not hasattr(library, "renameat2"):
        return False
    status = library.renameat2(
        _AT_FDCWD, os.fsencode(a), _AT_FDCWD, os.fsencode(b), _RENAME_EXCHANGE
    )
    if status == 0:
        return True
    code = ctypes.get_errno()
    if code in (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP):
        return False
    raise OSError(code, os.strerror(code), str(b))


def _aside(folder: Path) -> Path:
    return folder.parent / f".{folder.name}.old"


def _flush(folder: Path) -> None:
    for path in folder.rglob("*"):
        if path.is_file():
            with path.open("rb") as file:
                os.fsync(file.fileno())
        elif path.is_dir():
            _flush_folder(path)
    _flush_folder(folder)


def _flush_folder(folder: Path) -> None:
    if not hasattr(os, "O_DIRECTORY"):
        return
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _is_running(process: str) -> bool:
    if not process.isdigit():
        return False
    try:
        os.kill(int(process), 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


@contextlib.contextmanager
def _lock(folder: Path) -> Iterator[None]:
    """Hold the folder's lock; the file stays, the lock goes with the process."""
    path = folder.parent / f".{folder.name}.lock"
    try:
        import fcntl
    except ImportError:  # not a POSIX system
        yield
        return
    with path.open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise UserError(
                f"{folder}: another program is saving to it; try again later"
            ) from error
        yield
    path.unlink(missing_ok=True)
