"""Long output through the user's pager, so that its beginning does not run off the screen."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys

from maplab_py.console.foreground import terminal_lent

PAGER_VARIABLE = "MAPLAB_PAGER"
_DEFAULT = "less -FRXK"
"""Short text is only printed, colours are kept, the text stays, Ctrl-C leaves."""


def pager_command() -> str:
    """Return the pager: $MAPLAB_PAGER, else less; empty when there is none or it is `cat`."""
    configured = os.environ.get(PAGER_VARIABLE)
    if configured is not None:
        return "" if configured.strip() == "cat" else configured.strip()
    return _DEFAULT if shutil.which("less") else ""


def page(text: str) -> bool:
    """Show text by the pager if it is longer than the terminal; tell whether that was done."""
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        return False
    pager = pager_command()
    if not pager or text.count("\n") < shutil.get_terminal_size().lines:
        return False
    sys.stdout.flush()
    with terminal_lent():
        subprocess.run(pager, shell=True, input=text, text=True, check=False)
    return True
