"""The wish to stop a command: a token that the command's thread looks at by Progress.check.

An exception thrown from a signal handler would be swallowed by native code or leave it half done,
so Ctrl-C only sets the token of the running command.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from maplab_py.errors import Cancelled


class CancelToken:
    """Whether somebody wants one command to stop.

    Attributes:
        cancelled: The command shall raise Cancelled at its next check.
        abandoned: Nobody waits for the command any more; whatever it still does has no effect.
    """

    def __init__(self) -> None:
        """Start without the wish."""
        self.cancelled = False
        self.abandoned = False

    def check(self) -> None:
        """Raise Cancelled if the command shall stop."""
        if self.cancelled:
            raise Cancelled("cancelled")


class _Current(threading.local):
    token: CancelToken | None = None


_current = _Current()


def current_token() -> CancelToken:
    """Return the token of the command that this thread runs; one that nobody sets if none."""
    return _current.token or CancelToken()


def check_cancelled() -> None:
    """Raise Cancelled if the command that this thread runs shall stop."""
    if _current.token is not None:
        _current.token.check()


@contextmanager
def obeying(token: CancelToken) -> Iterator[None]:
    """Make a token the one of this thread's command."""
    before = _current.token
    _current.token = token
    try:
        yield
    finally:
        _current.token = before
