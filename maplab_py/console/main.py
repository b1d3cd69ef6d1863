"""The program `maplab`: reads its command line and starts what it asks for."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from maplab_py.console.aliases import read_aliases
from maplab_py.console.arguments import USAGE, Arguments, parse_arguments
from maplab_py.console.log import start_logging
from maplab_py.console.output import ConsoleTerminal
from maplab_py.console.paths import user_aliases, user_flagfile
from maplab_py.console.registry import Registry, load_registry
from maplab_py.console.runner import Runner
from maplab_py.console.scripts import read_batch, read_script, run_batch
from maplab_py.console.session import Session
from maplab_py.console.settings import Layer
from maplab_py.console.status import Status
from maplab_py.errors import FlagError, UserError


def main(argv: Sequence[str] | None = None) -> int:
    """Run the console and return its exit status.

    Args:
        argv: Words behind the program's name; those of the process when not given.
    """
    terminal = ConsoleTerminal()
    try:
        arguments = parse_arguments(sys.argv[1:] if argv is None else argv)
        terminal.as_json = arguments.json
        if arguments.help or arguments.version:
            return _print_about(arguments)
        start_logging()
        return int(_start(arguments, terminal))
    except UserError as error:
        terminal.error(str(error))
        return int(Status.USER_ERROR)
    except KeyboardInterrupt:
        return int(Status.CANCELLED)
    except BrokenPipeError:
        sys.stderr.close()
        return int(Status.FAILED)


def _print_about(arguments: Arguments) -> int:
    if arguments.version:
        from importlib.metadata import version

        sys.stdout.write(f"maplab-py {version('maplab-py')}\n")
    else:
        sys.stdout.write(USAGE + "\n")
    return int(Status.OK)


def _start(arguments: Arguments, terminal: ConsoleTerminal) -> Status:
    registry = load_registry()
    if arguments.mode == "batch":
        return _run_batches(arguments, terminal, registry)
    runner = make_runner(arguments, terminal, registry)
    if arguments.mode == "prompt" and sys.stdin.isatty():
        from maplab_py.console.prompt import run_prompt

        return run_prompt(runner)
    if arguments.mode == "command":
        status = runner.run_words(arguments.words)
    elif arguments.mode == "commands":
        status = runner.run_text(arguments.text, keep_going=arguments.keep_going)
    elif arguments.mode == "run":
        texts = [read_script(path) for path in arguments.files]
        status = runner.run_text("\n".join(texts), keep_going=arguments.keep_going)
    else:
        status = runner.run_text(sys.stdin.read(), keep_going=arguments.keep_going)
    return status or runner.finish(discard=arguments.discard)


def make_runner(arguments: Arguments, terminal: ConsoleTerminal, registry: Registry) -> Runner:
    """Start a session with the user's lasting flags.

    Raises:
        FlagError: A start-up flag or flag file is wrong. A wrong line in the user's own
            configuration is only warned of, so that the console can be used to mend it.
    """
    session = Session(registry, terminal)
    if user_flagfile().is_file():
        try:
            session.settings.assign_file(user_flagfile(), Layer.USER_CONFIG)
        except FlagError as error:
            terminal.warning(str(error))
    try:
        session.aliases.update(read_aliases(user_aliases()))
    except UserError as error:
        terminal.warning(str(error))
    for path in arguments.flagfiles:
        session.settings.assign_file(path, Layer.START_UP)
    session.settings.assign(arguments.flags, Layer.START_UP, "start-up")
    return Runner(session, terminal)


def _run_batches(arguments: Arguments, terminal: ConsoleTerminal, registry: Registry) -> Status:
    batches = [read_batch(path) for path in arguments.files]
    first = Status.OK
    for batch in batches:
        status = run_batch(
            batch,
            lambda: make_runner(arguments, terminal, registry),
            keep_going=arguments.keep_going,
            discard=arguments.discard,
        )
        first = first or status
        if status and not arguments.keep_going:
            break
    return first
