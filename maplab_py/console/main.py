"""The program `maplab`: reads its command line and starts what it asks for."""

from __future__ import annotations

import sys

from maplab_py.console.log import start_logging
from maplab_py.console.runner import Runner
from maplab_py.console.session import Session


def main() -> int:
    """Run the console and return its exit status."""
    start_logging()
    runner = Runner(Session())
    arguments = sys.argv[1:]
    if arguments[:1] == ["-c"]:
        return int(runner.run_text(arguments[1]))
    return int(runner.run_words(arguments))
