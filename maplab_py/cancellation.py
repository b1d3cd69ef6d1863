"""Cancellation of commands, and their lasting effects: written files, changed maps.

An exception thrown from a signal handler could be swallowed by native code or leave it in an
invalid state, so Ctrl-C only sets the token of the running command. A command that does not check
its token is abandoned: its thread continues, but nobody waits for it. This is safe because all
lasting effects happen inside `lasting_effect()`: an abandoned or cancelled command cannot enter it,
and a command inside it cannot be abandoned. Such a block is short: files are prepared beforehand.
"""

import contextlib
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from maplab_py.errors import Cancelled


class CancelToken:
    """Cancellation state of one command, and whether it has had lasting effects."""

    def __init__(self) -> None:
        """Create a token that is not cancelled."""
        self.cancelled = False  # the command is to raise Cancelled at its next check
        self.has_effects = False  # the command has had a lasting effect, such as a written file
        self.is_ending = False  # the command was asked to end early with what it has
        self._can_end_early = 0  # nested blocks that can
        self._abandoned = False
        self._depth = 0  # of nested effects
        self._is_done = False
        self._provisional = 0  # nested blocks whose effects are discarded unless their block ends
        self._lock = threading.Lock()
        self._cleanups: list[Callable[[], None]] = []

    @property
    def abandoned(self) -> bool:
        """The command has been abandoned: nothing that it still does has an effect."""
        return self._abandoned

    def check(self) -> None:
        """Raise Cancelled if the command has been cancelled."""
        if self.cancelled:
            raise Cancelled("cancelled")

    def request_end(self) -> bool:
        """Ask the command to end early with what it has; False if it cannot, or has been asked before.

        Signal handlers call this, so it takes no lock.
        """
        if not self._can_end_early or self.is_ending:
            return False
        self.is_ending = True
        return True

    def abandon(self) -> bool:
        """Prevent all further effects of the command; False while it is inside one, or has finished."""
        self.cancelled = True
        with self._lock:
            if self._depth or self._is_done:
                return False
            self._abandoned = True
            cleanups, self._cleanups = self._cleanups, []
        for cleanup in cleanups:
            cleanup()
        return True

    @contextmanager
    def effect(self, *, is_last: bool = False) -> Iterator[None]:
        """Context of a lasting effect; see `lasting_effect`."""
        with self._lock:
            if self._abandoned or (self.cancelled and not self._depth and not self.has_effects):
                raise Cancelled("cancelled")
            self._depth += 1
        try:
            yield
            self.has_effects = self.has_effects or not self._provisional
            self._is_done = self._is_done or is_last
        finally:
            with self._lock:
                self._depth -= 1

    @contextmanager
    def provisional(self) -> Iterator[None]:
        """Do not count the effects inside; see `provisional_effects`."""
        self._provisional += 1
        try:
            yield
        finally:
            self._provisional -= 1

    @contextmanager
    def ending_early(self) -> Iterator[None]:
        """Context of work that can end early; see `ending_early`."""
        if not self._can_end_early:
            self.is_ending = False  # an earlier block was asked to end, not this one
        self._can_end_early += 1
        try:
            yield
        finally:
            self._can_end_early -= 1

    @contextmanager
    def cleaning(self, cleanup: Callable[[], None]) -> Iterator[None]:
        """Call a function at the end of the block, or earlier when the command is abandoned."""
        with self._lock:
            self._cleanups.append(cleanup)
        try:
            yield
        finally:
            with self._lock, contextlib.suppress(ValueError):
                self._cleanups.remove(cleanup)
            cleanup()


class _Current(threading.local):
    token: CancelToken | None = None


_current = _Current()


def current_token() -> CancelToken:
    """Return the token of the command that this thread runs; a token that is never set if there is none."""
    return _current.token or CancelToken()


def check_cancelled() -> None:
    """Raise Cancelled if the command of this thread has been cancelled."""
    if _current.token is not None:
        _current.token.check()


@contextmanager
def lasting_effect(*, is_last: bool = False) -> Iterator[None]:
    """Context of an effect that outlives the running command: renaming a file, changing the session.

    The block must be short, because Ctrl-C waits for its end. Blocks may be nested.

    Args:
        is_last: The command ends with this effect and can no longer be abandoned.

    Raises:
        Cancelled: The command has been abandoned, or cancelled before its first effect.
    """
    with current_token().effect(is_last=is_last):
        yield


@contextmanager
def provisional_effects() -> Iterator[None]:
    """Count no effect inside as lasting: everything happens in a place that may still be deleted.

    Files written to a temporary folder are an example. A cancelled command stops at their next check.
    """
    with current_token().provisional():
        yield


@contextmanager
def ending_early() -> Iterator[Callable[[], bool]]:
    """Let the first Ctrl-C in the block ask the command to end early instead of cancelling it.

    The block receives a function that tells whether this has happened. The command then finishes soon and
    returns normally, and its result counts. A second Ctrl-C cancels the command.
    """
    token = current_token()
    with token.ending_early():
        yield lambda: token.is_ending


@contextmanager
def cleaned_up(cleanup: Callable[[], None]) -> Iterator[None]:
    """Call a function at the end of the block, or at once when the command is abandoned in it.

    This removes the temporary files of a command before the prompt returns. The function may be called
    twice, and by another thread.
    """
    with current_token().cleaning(cleanup):
        yield


@contextmanager
def obeying(token: CancelToken) -> Iterator[None]:
    """Use a token for the command of this thread."""
    before = _current.token
    _current.token = token
    try:
        yield
    finally:
        _current.token = before
