"""Long output is shown in the user's pager."""

from __future__ import annotations

import array
import fcntl
import os
import shutil
import subprocess
import sys
import termios

from maplab_py.console.terminal.foreground import terminal_lent

PAGER_VARIABLE = "MAPLAB_PAGER"
_DEFAULT = "less -FRXK"
"""Short text is only printed, colours are kept, the text stays, Ctrl-C leaves."""


_SCREENS = 2
"""Longer reports are paged."""


def pager_command() -> str:
    """Return the pager: $MAPLAB_PAGER, else less; empty when there is none or it is `cat`."""
    configured = os.environ.get(PAGER_VARIABLE)
    if configured is not None:
        return "" if configured.strip() == "cat" else configured.strip()
    return _DEFAULT if shutil.which("less") else ""


def page(text: str) -> bool:
    """Show text by the pager if it is longer than two screens; return whether it was shown.

    If keys have been typed meanwhile, they are for the prompt: the pager would take them.
    """
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        return False
    pager = pager_command()
    if not pager or text.count("\n") <= _SCREENS * shutil.get_terminal_size().lines:
        return False
    if keys_are_waiting():
        return False
    sys.stdout.flush()
    with terminal_lent():
        subprocess.run(pager, shell=True, input=text, text=True, check=False)
    return True


def keys_are_waiting() -> bool:
    """Tell whether keys have been typed that no program has read yet, with or without Enter."""
    try:
        number = sys.stdin.fileno()
        settings = termios.tcgetattr(number)
        immediate = list(settings)
        immediate[3] &= ~termios.ICANON  # otherwise an unfinished line is not counted
        count = array.array("i", [0])
        termios.tcsetattr(number, termios.TCSANOW, immediate)
        try:
            fcntl.ioctl(number, termios.FIONREAD, count)
        finally:
            termios.tcsetattr(number, termios.TCSANOW, settings)
    except (AttributeError, OSError, ValueError, termios.error):
        return False
    return count[0] > 0
