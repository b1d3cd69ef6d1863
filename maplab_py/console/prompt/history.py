"""History file of typed lines, shared by several consoles."""

from __future__ import annotations

import datetime as dt
import logging
import os
from pathlib import Path

from prompt_toolkit.history import FileHistory, History, InMemoryHistory

_RECENT_BYTES = 100_000
"""Part of the history that the ranking of completions takes into account."""

logger = logging.getLogger(__name__)


class KeptHistory(FileHistory):
    """A history file; a line that cannot be written is kept in memory only."""

    def store_string(self, string: str) -> None:
        """Append a line in one write, completely or not at all."""
        lines = "".join(f"+{line}\n" for line in string.split("\n"))
        data = f"\n# {dt.datetime.now()}\n{lines}".encode()
        try:
            _append(Path(os.fsdecode(self.filename)), data)
        except OSError:
            logger.warning("%s: a line is not kept", self.filename, exc_info=True)


def open_history(path: Path) -> tuple[History, str]:
    """Return a history that is kept in a file, else one in memory and the reason for that."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
        with path.open("rb"):
            pass
    except OSError as error:
        return InMemoryHistory(), str(error)
    return KeptHistory(str(path)), ""


def recent_commands(path: Path) -> list[str]:
    """Return the first words of the lines at the end of a history file; none if it is unreadable."""
    try:
        with path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - _RECENT_BYTES))
            lines = file.read().decode(errors="replace").splitlines()[1:]
    except OSError:
        return []
    return [line[1:].split(maxsplit=1)[0] for line in lines if line[:1] == "+" and line[1:].strip()]


def _append(path: Path, data: bytes) -> None:
    descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
    try:
        size = os.fstat(descriptor).st_size
        if os.write(descriptor, data) != len(data):
            os.ftruncate(descriptor, size)
    finally:
        os.close(descriptor)
