"""The log file of a session: typed commands, warnings and tracebacks."""

import logging
import sys
from pathlib import Path

from maplab_py.console.session.paths import state_folder
from maplab_py.console.terminal.streams import write_message

_MAX_BYTES = 2_000_000
_KEPT_FILES = 5
_project = logging.getLogger("maplab_py")
_project.addHandler(logging.NullHandler())  # a Python program decides by itself what to log
_FORMAT = "%(asctime)s %(process)d %(levelname)s %(name)s: %(message)s"


def log_path() -> Path:
    """Return the path of the log file."""
    return state_folder() / "maplab.log"


def start_logging() -> None:
    """Send the project's log records to the rotating log file.

    If the file cannot be written, a warning is printed and the session runs without it.
    """
    if any(not isinstance(handler, logging.NullHandler) for handler in _project.handlers):
        return
    _project.setLevel(logging.INFO)
    _project.propagate = False
    try:
        _project.addHandler(_file_handler(log_path()))
    except OSError as error:
        write_message(sys.stderr, f"warning: no log file: {error}")


def _file_handler(path: Path) -> logging.Handler:
    from logging.handlers import RotatingFileHandler

    class Handler(RotatingFileHandler):
        """Warns once if the file cannot be written any more: a full disk ends no command."""

        has_warned = False

        def handleError(self, _: logging.LogRecord) -> None:
            if not self.has_warned:
                self.has_warned = True
                write_message(sys.stderr, f"warning: no more log: {sys.exc_info()[1]}")

    path.parent.mkdir(parents=True, exist_ok=True)
    handler = Handler(
        path, maxBytes=_MAX_BYTES, backupCount=_KEPT_FILES, encoding="utf-8", delay=True
    )
    handler.setFormatter(logging.Formatter(_FORMAT))
    return handler
