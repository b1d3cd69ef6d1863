"""Running one command for a waiting user: it works in a thread, while this one hears Ctrl-C.

So the prompt comes back soon even when the command is deep inside native code, which no signal
can leave: its thread is then left to itself, and as maps are values what it still computes
reaches nobody.
"""

from __future__ import annotations

import queue
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, TypeVar

from maplab_py.console.cancellation import CancelToken, obeying
from maplab_py.errors import Cancelled

SECONDS_OF_GRACE = 0.3
_SECONDS_BETWEEN_LOOKS = 0.05

T = TypeVar("T")


class _Request:
    """Something that the command's thread wants done in the waiting thread, or its end."""

    def __init__(self, function: Callable[[], Any] | None = None) -> None:
        self.function = function
        self.value: Any = None
        self.error: BaseException | None = None
        self.done = threading.Event()

    def fulfil(self) -> None:
        try:
            self.value = self.function() if self.function else None
        except BaseException as error:  # noqa: BLE001 - it belongs to the other thread
            self.error = error
        self.done.set()


class _Here(threading.local):
    requests: queue.SimpleQueue[_Request] | None = None


_here = _Here()


def in_waiting_thread(function: Callable[[], T]) -> T:
    """Run a function in the thread that waits for this command, as questions must be.

    A question would otherwise go on reading the keyboard after its command was cancelled.
    """
    if _here.requests is None:
        return function()
    request = _Request(function)
    _here.requests.put(request)
    request.done.wait()
    if request.error is not None:
        raise request.error
    value: T = request.value
    return value


def run_in_foreground(
    name: str,
    work: Callable[[], T],
    *,
    may_be_abandoned: bool = True,
    while_waiting: Callable[[], None] = lambda: None,
) -> T:
    """Run `work`, let Ctrl-C cancel it, and return its result or raise its error.

    Outside the main thread, where no signal arrives, it is simply run.

    Args:
        name: Name of the command, for messages.
        work: What to run; it learns of Ctrl-C by `check_cancelled`.
        may_be_abandoned: Its thread may be left behind when it does not stop soon; not so when it
            writes files.
        while_waiting: Called many times a second.

    Raises:
        Cancelled: It was cancelled.
    """
    if threading.current_thread() is not threading.main_thread() or _here.requests is not None:
        return work()
    token = CancelToken()
    requests: queue.SimpleQueue[_Request] = queue.SimpleQueue()
    end = _Request(work)

    def body() -> None:
        _here.requests = requests
        with obeying(token):
            end.fulfil()
        requests.put(end)

    with _interrupts(name, token) as pressed:
        threading.Thread(target=body, name=f"command {name}", daemon=True).start()
        while (request := _next(requests)) is not end:
            if request is not None:
                request.fulfil()
            elif pressed and may_be_abandoned and _is_over(pressed[0]):
                token.abandoned = True
                raise Cancelled("cancelled")
            while_waiting()
    if end.error is not None:
        raise end.error
    value: T = end.value
    return value


def _next(requests: queue.SimpleQueue[_Request]) -> _Request | None:
    try:
        return requests.get(timeout=_SECONDS_BETWEEN_LOOKS)
    except queue.Empty:
        return None


def _is_over(pressed: float) -> bool:
    return time.monotonic() - pressed > SECONDS_OF_GRACE


@contextmanager
def _interrupts(name: str, token: CancelToken) -> Iterator[list[float]]:
    """Collect the times at which Ctrl-C is pressed; the handler before is restored afterwards."""
    pressed: list[float] = []

    def handle(signal_number: int, frame: FrameType | None) -> None:  # noqa: ARG001
        token.cancelled = True
        pressed.append(time.monotonic())
        if len(pressed) > 1:
            sys.stderr.write(f"\n{name} still runs and stops at its next check\n")
            sys.stderr.flush()

    before = signal.signal(signal.SIGINT, handle)
    try:
        yield pressed
    finally:
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


@contextmanager
def terminal_lent() -> Iterator[None]:
    """Leave Ctrl-C to a program that has the terminal inside, as a pager or a shell command.

    The key reaches both; were we to end as well, both would read what is typed next. A handler
    that does nothing is not inherited by the program, other than the order to ignore the signal.
    """
    is_main = threading.current_thread() is threading.main_thread()
    if not (is_main and sys.stdin.isatty()):
        yield
        return
    before = signal.signal(signal.SIGINT, lambda *_: None)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
