"""Operating system calls for atomic writing: flushing, exchanging names, locks."""

import ctypes
import errno
import logging
import os
import sys
from collections.abc import Collection
from pathlib import Path

from maplab_py.cancellation import check_cancelled

try:
    import fcntl
except ImportError:  # not a POSIX system: nobody is locked out
    fcntl = None  # type: ignore[assignment]

RENAMES_OPEN_FILES = fcntl is not None
_RENAME_EXCHANGE = 2
_AT_FDCWD = -100
_UNSUPPORTED = (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP)

logger = logging.getLogger(__name__)


def flush_folder(folder: Path) -> None:
    """Flush the names in a folder to disk, where the file system can."""
    if not hasattr(os, "O_DIRECTORY"):
        return
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in _UNSUPPORTED:
            raise
    finally:
        os.close(descriptor)


def flush_tree(folder: Path, on_disk: Collection[Path] = ()) -> None:
    """Flush all files and folders below a folder, and the folder itself, to disk.

    Args:
        on_disk: Files that are left out, as their content is on disk.
    """
    for path in sorted(folder.rglob("*")):
        check_cancelled()
        if path.is_symlink():
            continue
        if path.is_dir():
            flush_folder(path)
        elif path.is_file() and path not in on_disk:
            descriptor = os.open(path, os.O_RDONLY)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
    flush_folder(folder)


def exchanged(a: Path, b: Path) -> bool:
    """Exchange two names in one step (renameat2); False where the system cannot."""
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
    if code in _UNSUPPORTED:
        return False
    raise OSError(code, os.strerror(code), str(b))


def opened_locked(path: Path) -> int | None:
    """Open a file, made when it is missing, and lock it; None while another process holds the lock.

    The lock goes when the descriptor is closed or the process ends. On file systems without locks
    the descriptor is returned unlocked.

    Raises:
        OSError: The file cannot be opened.
    """
    flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0)
    while True:
        descriptor = os.open(path, flags, 0o666)
        try:
            if fcntl is not None:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            return None
        except OSError:  # a file system without locks
            logger.info("%s: cannot be locked", path, exc_info=True)
        if _is_at(descriptor, path):
            return descriptor
        os.close(descriptor)  # the holder before us has renamed or deleted the file


def _is_at(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), os.lstat(path))
    except FileNotFoundError:
        return False
