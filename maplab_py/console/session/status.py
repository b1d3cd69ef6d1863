"""Exit statuses, and which error means which."""

import os
from enum import IntEnum

from maplab_py.console.session.log import log_path
from maplab_py.errors import Cancelled, MaplabError, UserError


class Status(IntEnum):
    """Exit status of a command, a script or the whole console."""

    OK = 0
    FAILED = 1
    USER_ERROR = 2
    CANCELLED = 130


def describe(error: BaseException) -> str:
    """Describe an error and its remedy in one line."""
    if isinstance(error, MaplabError):
        return " ".join(str(error).split("\n"))
    if isinstance(error, MemoryError):
        what = f" ({str(error).splitlines()[0]})" if str(error) else ""
        return (
            f"there is not enough memory{what}; sparsify the map (kfh, landmark_sparsify), "
            "work on fewer missions, or use a larger machine"
        )
    if isinstance(error, OSError) and error.strerror:
        place = f"{os.fsdecode(error.filename)}: " if error.filename is not None else ""
        return f"{place}{error.strerror}"
    reason = (f"{type(error).__name__}: {error}".splitlines() or [""])[0]
    return f"{reason} (an error of the program; see {log_path()})"


def status_of(error: BaseException) -> Status:
    """Return the status that an error leads to."""
    if isinstance(error, (Cancelled, KeyboardInterrupt)):
        return Status.CANCELLED
    return Status.USER_ERROR if isinstance(error, UserError) else Status.FAILED
