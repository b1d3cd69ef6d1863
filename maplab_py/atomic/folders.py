"""Folders that are replaced as a whole.

Where the system can exchange two names in one step (Linux, renameat2), that is the swap; elsewhere
the old folder is first moved aside, and `recover` moves it back if the program died between the two
renames.
"""

import contextlib
import logging
import os
import shutil
import time
from collections.abc import Callable, Collection, Iterator
from functools import partial
from pathlib import Path

from maplab_py.atomic.files import make_folders, reason, remove_folders, resolved, sibling
from maplab_py.atomic.system import exchanged, flush_folder, flush_tree, opened_locked
from maplab_py.cancellation import cleaned_up, lasting_effect, provisional_effects
from maplab_py.errors import UserError

_SECONDS_TO_WAIT = 2.0
_SECONDS_BETWEEN_LOOKS = 0.01

logger = logging.getLogger(__name__)


@contextlib.contextmanager
def replaced_folder(path: Path, on_disk: Collection[Path] = ()) -> Iterator[Path]:
    """Yield a temporary folder to fill; it replaces `path` at the end of the block.

    Parent folders are created. A symbolic link is kept and its target is replaced. After an exception,
    or if the running command has been cancelled, the temporary folder is deleted and nothing has
    changed.

    Args:
        path: The folder.
        on_disk: Files in the temporary folder whose content need not be flushed, such as links to files
            that were published before; the block may still add to it.

    Raises:
        UserError: Another program is saving to the same folder, the folder cannot be replaced, or
            the disk refuses.
    """
    folder = resolved(path)
    made: list[Path] = []
    is_published = False
    try:
        check_replaceable(folder)
        made = make_folders(folder.parent)
        with _locked(folder) as has_lock:
            if not has_lock:
                raise UserError(f"{path}: another program is saving to it; try again later")
            _clean(folder)
            temporary = sibling(folder, "saving")
            with cleaned_up(partial(_delete, temporary)):
                temporary.mkdir()
                with provisional_effects():
                    yield temporary
                flush_tree(temporary, on_disk)
                with lasting_effect():
                    _swap(temporary, folder, made)
                    is_published = True
    except OSError as error:
        raise UserError(f"{path}: cannot be saved ({_place(error, folder)})") from error
    finally:
        if not is_published:
            remove_folders(made)


def move_folder(folder: Path, target: Path) -> None:
    """Rename a folder, on one file system, and flush the names to disk.

    Raises:
        OSError: It cannot be renamed; it is where it was.
        Cancelled: The running command has been cancelled.
    """
    with lasting_effect():
        os.rename(folder, target)
        for parent in {folder.parent, target.parent}:
            flush_folder(parent)


def recover(path: Path) -> None:
    """Recover from a save that was killed: move the old folder back, delete temporary folders.

    Does nothing while another program saves to the folder; between the two renames of that program,
    waits until the folder exists.
    """
    try:
        folder = resolved(path)
        deadline = time.monotonic() + _SECONDS_TO_WAIT
        while any(os.path.lexists(sibling(folder, suffix)) for suffix in ("saving", "old", "lock")):
            with _locked(folder) as has_lock:
                if has_lock:
                    _clean(folder)
                    return
            if folder.exists() or time.monotonic() > deadline:
                return
            time.sleep(_SECONDS_BETWEEN_LOOKS)
    except (OSError, UserError):  # without write permission nothing can be cleaned up
        logger.info("%s: nothing recovered", path, exc_info=True)


def check_replaceable(folder: Path) -> None:
    """Refuse a folder that could not be deleted after its replacement.

    Raises:
        UserError: It is a file, or it or a folder in it is read-only.
    """
    if not os.path.lexists(folder):
        return
    if not folder.is_dir():
        raise UserError(f"{folder} is a file; give a folder")
    for name, _, _ in os.walk(folder):
        if not os.access(name, os.R_OK | os.W_OK | os.X_OK):
            raise UserError(
                f"{name} is read-only, so it cannot be replaced; make it writable or save to "
                "another folder"
            )


def _swap(new: Path, folder: Path, made: list[Path]) -> None:
    """Replace `folder` by `new`; the old folder is called `new` afterwards."""
    undo = _put_in_place(new, folder)
    try:
        for parent in (folder.parent, *(created.parent for created in made)):
            flush_folder(parent)
    except OSError:
        with contextlib.suppress(OSError):
            undo()
        raise
    _delete(sibling(folder, "old"))


def _put_in_place(new: Path, folder: Path) -> Callable[[], object]:
    """Rename; return a function that undoes it."""
    if not folder.exists():
        new.rename(folder)
        return lambda: folder.rename(new)
    if exchanged(new, folder):
        return lambda: exchanged(new, folder)
    aside = sibling(folder, "old")
    folder.rename(aside)
    try:
        new.rename(folder)
    except OSError:
        aside.rename(folder)
        raise

    def undo() -> None:
        folder.rename(new)
        aside.rename(folder)

    return undo


def _clean(folder: Path) -> None:
    """Clean up after a killed process; requires the lock."""
    aside = sibling(folder, "old")
    if aside.is_dir() and not folder.exists():
        aside.rename(folder)
        flush_folder(folder.parent)
    _delete(aside)
    _delete(sibling(folder, "saving"))


def _delete(path: Path) -> None:
    """Delete a folder or file; if this fails twice, the next save or load deletes it."""
    for _ in range(2):
        if not os.path.lexists(path):
            return
        with contextlib.suppress(OSError):  # rmtree raises where closing a folder fails
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink()
    if os.path.lexists(path):
        logger.warning("%s: cannot be deleted", path)


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[bool]:
    """Hold the lock of a folder, a file beside it; yields False while another process holds it."""
    path = sibling(folder, "lock")
    descriptor = opened_locked(path)
    try:
        yield descriptor is not None
    finally:
        if descriptor is not None:
            _delete(path)
            with contextlib.suppress(OSError):
                os.close(descriptor)


def _place(error: OSError, folder: Path) -> str:
    """Return the cause of an error, with the path where it is not inside the new folder."""
    name = os.fsdecode(error.filename) if isinstance(error.filename, (str, bytes)) else ""
    if name and Path(name) in (sibling(folder, "lock"), sibling(folder, "saving")):
        return f"{folder.parent}: {reason(error)}"
    return reason(error)
