"""Foreground commands run in a worker thread while the main thread handles Ctrl-C.

The prompt therefore returns soon even if the command is inside native code, which no signal can
interrupt: its thread is abandoned, and as maps are immutable its result has no effect.
"""

import queue
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, TypeVar

from maplab_py.cancellation import CancelToken, obeying
from maplab_py.console.terminal.streams import write_message
from maplab_py.errors import Cancelled

SECONDS_OF_GRACE = 0.3
_SECONDS_BETWEEN_LOOKS = 0.05

ABANDONED: list[threading.Thread] = []
"""Abandoned threads that may still run."""

T = TypeVar("T")


class _Request:
    """Request of the command's thread to the waiting thread, or its end."""

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
    """Run a function in the thread that waits for this command.

    Questions need this: otherwise they would still read the keyboard after a cancellation.
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
    token: CancelToken | None = None,
    while_waiting: Callable[[], None] = lambda: None,
) -> T:
    """Run `work`, let Ctrl-C cancel it, and return its result or raise its error.

    Inside `ending_early` the first Ctrl-C asks the work to end early instead.
    Work that does not stop soon is abandoned, unless it is inside a `lasting_effect`. Outside the
    main thread, which receives no signals, it runs directly.

    Args:
        name: Name of the command, for messages.
        work: Function to run; `check_cancelled` tells it about Ctrl-C.
        token: Holds whether Ctrl-C was pressed and whether the work had effects.
        while_waiting: Called many times a second.

    Raises:
        Cancelled: It was cancelled.
    """
    if threading.current_thread() is not threading.main_thread() or _here.requests is not None:
        return work()
    token = token or CancelToken()
    requests: queue.SimpleQueue[_Request] = queue.SimpleQueue()
    end = _Request(work)

    def body() -> None:
        _here.requests = requests
        with obeying(token):
            end.fulfil()
        requests.put(end)

    with _interrupts(name, token) as pressed:
        thread = threading.Thread(target=body, name=f"command {name}", daemon=True)
        thread.start()
        while (request := _next(requests)) is not end:
            if request is not None:
                request.fulfil()
            elif pressed and time.monotonic() - pressed[0] > SECONDS_OF_GRACE and token.abandon():
                ABANDONED.append(thread)
                raise Cancelled("cancelled")
            while_waiting()
    if end.error is not None:
        raise end.error
    value: T = end.value
    return value


def abandoned_commands_run() -> bool:
    """Return whether abandoned threads still run after a short grace period."""
    end = time.monotonic() + SECONDS_OF_GRACE
    for thread in ABANDONED:
        thread.join(max(0.0, end - time.monotonic()))
    return any(thread.is_alive() for thread in ABANDONED)


def _next(requests: queue.SimpleQueue[_Request]) -> _Request | None:
    try:
        return requests.get(timeout=_SECONDS_BETWEEN_LOOKS)
    except queue.Empty:
        return None


class NotedInterrupts:
    """A handler of Ctrl-C that only notes it, for the next command.

    An exception may fall into a destructor, where Python ignores it with a message.
    """

    def __init__(self) -> None:
        self.is_noted = False  # Ctrl-C was pressed
        self.instead: Callable[[], None] | None = None  # called instead of noting it

    def __call__(self, signal_number: int, frame: FrameType | None) -> None:  # noqa: ARG002
        """Note it."""
        if self.instead is None:
            self.is_noted = True
        else:
            self.instead()


@contextmanager
def interrupts_noted() -> Iterator[NotedInterrupts]:
    """Note Ctrl-C inside, as between commands at the prompt; a command that follows is cancelled."""
    noted = NotedInterrupts()
    if threading.current_thread() is not threading.main_thread():
        yield noted
        return
    before = signal.signal(signal.SIGINT, noted)
    try:
        yield noted
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def _interrupts(name: str, token: CancelToken) -> Iterator[list[float]]:
    """Collect the times at which Ctrl-C is pressed; the previous handler is restored afterwards."""
    pressed: list[float] = []

    def handle(signal_number: int, frame: FrameType | None) -> None:  # noqa: ARG001
        if token.request_end():
            write_message(sys.stderr, f"\n{name}: ends with what it has; Ctrl-C again cancels it")
            return
        token.cancelled = True
        pressed.append(time.monotonic())
        if len(pressed) > 1:
            write_message(sys.stderr, f"\n{name} is still running and stops at its next check")

    before = signal.signal(signal.SIGINT, handle)
    if isinstance(before, NotedInterrupts) and before.is_noted:  # pressed just before
        before.is_noted = False
        handle(signal.SIGINT, None)
    try:
        yield pressed
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def interruptible() -> Iterator[None]:
    """Let Ctrl-C raise KeyboardInterrupt, as while a question waits for its answer."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def terminations_as_interrupts() -> Iterator[None]:
    """Treat SIGTERM, and SIGHUP where there is one, as Ctrl-C, so that what a script has made is kept."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def handle(signal_number: int, frame: FrameType | None) -> None:  # noqa: ARG001
        if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:  # as in background jobs of shells
            raise KeyboardInterrupt
        signal.raise_signal(signal.SIGINT)

    numbers = (getattr(signal, name, None) for name in ("SIGTERM", "SIGHUP"))
    before = {number: signal.getsignal(number) for number in numbers if number is not None}
    for number, handler in before.items():
        if handler == signal.SIG_DFL:
            signal.signal(number, handle)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def terminal_lent() -> Iterator[None]:
    """Leave Ctrl-C to a child program that uses the terminal, such as a pager or a shell command.

    Both processes receive the signal; this one must not react. An empty handler is used because,
    unlike SIG_IGN, child processes do not inherit it.
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


@contextmanager
def cancelling_interrupts() -> Iterator[None]:
    """Let Ctrl-C raise KeyboardInterrupt, and `check_cancelled` raise from then on.

    Shells start background jobs of scripts with the signal ignored, and Python then sets no handler: an
    interrupt would be lost. So it would be inside finalisers, where Python discards exceptions.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    token = CancelToken()

    def handle(signal_number: int, frame: FrameType | None) -> None:  # noqa: ARG001
        token.cancelled = True
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, handle)
    try:
        with obeying(token):
            yield
    finally:
        signal.signal(signal.SIGINT, before)
