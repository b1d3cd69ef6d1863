"""The standard streams of the process: closed, broken and full ones."""

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from maplab_py.errors import MaplabError

PIPE_STATUS = 128 + 13  # the number of SIGPIPE, which not every system has
"""Exit status of a program whose output pipe was closed, as a shell reports it."""


class OutputError(MaplabError):
    """Standard output cannot be written, for instance because the disk is full."""


class PipeClosed(BaseException):
    """The reader of standard output, such as `head`, has closed the pipe; the program ends quietly."""


def open_closed_streams() -> None:
    """Give a process that was started without some of its standard streams empty ones.

    Otherwise the next file that is opened, such as a map's, would become the standard output of all
    native code.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            _open_null(number)
        if getattr(sys, name) is None:
            mode = "r" if name == "stdin" else "w"
            setattr(sys, name, Path(os.devnull).open(mode, encoding="utf-8"))  # noqa: SIM115


@contextlib.contextmanager
def writing_output() -> Iterator[None]:
    """Convert errors of writing to standard output into exceptions of the console.

    Raises:
        PipeClosed: The reader of the pipe has closed it.
        OutputError: Anything else, in one line.
    """
    try:
        yield
    except BrokenPipeError:
        discard_output()
        raise PipeClosed from None
    except OSError as error:
        discard_output()
        raise OutputError(f"standard output cannot be written: {error.strerror}") from None


def discard_output() -> None:
    """Redirect standard output to the null device, so that the final flush of Python does not fail."""
    with contextlib.suppress(OSError, ValueError):
        number = sys.stdout.fileno()
        _open_null(number)
    with contextlib.suppress(OSError, ValueError):
        sys.stdout.flush()


def write_message(stream: IO[str], text: str) -> None:
    """Write a line to standard error; a failure is ignored."""
    try:
        stream.write(text + "\n")
        stream.flush()
    except (OSError, ValueError):
        if stream is sys.stderr:
            with contextlib.suppress(OSError, ValueError):
                _open_null(stream.fileno())


def _open_null(number: int) -> None:
    """Redirect a file descriptor to the null device."""
    null = os.open(os.devnull, os.O_RDWR)
    if null != number:
        os.dup2(null, number)
        os.close(null)
