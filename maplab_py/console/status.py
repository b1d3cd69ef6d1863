"""Exit statuses, and which error means which."""

from __future__ import annotations

from enum import IntEnum

from maplab_py.errors import Cancelled, UserError


class Status(IntEnum):
    """How a command, a script or the whole console ended."""

    OK = 0
    FAILED = 1
    USER_ERROR = 2
    CANCELLED = 130


def status_of(error: BaseException) -> Status:
    """Return the status that an error leads to."""
    if isinstance(error, (Cancelled, KeyboardInterrupt)):
        return Status.CANCELLED
    return Status.USER_ERROR if isinstance(error, UserError) else Status.FAILED
