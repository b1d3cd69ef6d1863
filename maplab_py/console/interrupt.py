"""Ctrl-C: the signal handler only sets a flag, which running commands look at by Progress.check.

An exception thrown from a signal handler would be swallowed by native code or leave it half done.
"""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from maplab_py.errors import Cancelled


class _Wish:
    """Whether the user wants the running command to stop."""

    def __init__(self) -> None:
        self.depth = 0
        self.count = 0


_wish = _Wish()


def check_cancelled() -> None:
    """Raise Cancelled if the user has asked to stop the running command."""
    if _wish.count:
        raise Cancelled("cancelled")


@contextmanager
def cancellable(command: str) -> Iterator[None]:
    """Let Ctrl-C cancel what runs inside; the handler before is restored afterwards."""
    if threading.current_thread() is not threading.main_thread() or _wish.depth:
        yield
        return

    def handle(signal_number: int, frame: FrameType | None) -> None:  # noqa: ARG001
        _wish.count += 1
        if _wish.count > 1:
            sys.stderr.write(f"\n{command} still runs and stops at its next check\n")
            sys.stderr.flush()

    before = signal.signal(signal.SIGINT, handle)
    _wish.depth, _wish.count = 1, 0
    try:
        yield
    finally:
        _wish.depth, _wish.count = 0, 0
        signal.signal(signal.SIGINT, before)


@contextmanager
def interruptible() -> Iterator[None]:
    """Let Ctrl-C raise KeyboardInterrupt inside, as while a question waits for its answer."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
