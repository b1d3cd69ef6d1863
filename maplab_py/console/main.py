"""The program `maplab`: reads its command line and starts what it asks for."""

from __future__ import annotations

import atexit
import contextlib
import os
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from maplab_py import kernel_cache
from maplab_py.child_processes import end_with_parent
from maplab_py.console.commands.flags import parse_words
from maplab_py.console.commands.registry import Registry, load_registry
from maplab_py.console.scripts.aliases import read_aliases
from maplab_py.console.scripts.arguments import USAGE, Arguments, parse_arguments
from maplab_py.console.scripts.batch import read_batch, read_script, run_batch
from maplab_py.console.scripts.runner import Runner
from maplab_py.console.session.log import start_logging
from maplab_py.console.session.paths import user_aliases, user_flagfile
from maplab_py.console.session.session import Session
from maplab_py.console.session.settings import Layer
from maplab_py.console.session.status import Status
from maplab_py.console.terminal.foreground import abandoned_commands_run
from maplab_py.console.terminal.output import ConsoleTerminal
from maplab_py.console.terminal.streams import (
    PIPE_STATUS,
    OutputError,
    PipeClosed,
    open_closed_streams,
    writing_output,
)
from maplab_py.errors import FlagError, MaplabError, UserError
from maplab_py.pipeline.options import PipelineOptions

_MAPS_FOLDER = "maps_folder"
_TOUR = "tour"
"""The command that goes on at the prompt when the program is started with it."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the console and return its exit status.

    Args:
        argv: Words behind the program's name. When they are not given, those of the process are
            taken, and the process ends here if an abandoned command still runs.
    """
    end_with_parent()
    open_closed_streams()
    status = _main(sys.argv[1:] if argv is None else argv)
    if argv is None and abandoned_commands_run():
        with contextlib.suppress(OSError, ValueError):
            sys.stdout.flush()
            sys.stderr.flush()
        atexit._run_exitfuncs()
        os._exit(status)  # Python would wait for the threads, or end them inside native code
    return status


def _main(argv: Sequence[str]) -> int:
    terminal = ConsoleTerminal()
    try:
        arguments = parse_arguments(argv)
        terminal.as_json = arguments.json
        if arguments.help or arguments.version:
            return _print_about(arguments)
        start_logging()
        kernel_cache.tell_user = terminal.warning
        return int(_start(arguments, terminal))
    except UserError as error:
        terminal.error(str(error))
        return int(Status.USER_ERROR)
    except MaplabError as error:
        terminal.error(str(error))
        return int(Status.FAILED)
    except KeyboardInterrupt:
        return int(Status.CANCELLED)
    except PipeClosed:
        return PIPE_STATUS
    except OutputError as error:
        terminal.error(str(error))
        return int(Status.FAILED)


def _print_about(arguments: Arguments) -> int:
    if arguments.version:
        from importlib.metadata import version

        text = f"maplab-py {version('maplab-py')}"
    else:
        text = USAGE
    with writing_output():
        sys.stdout.write(text + "\n")
        sys.stdout.flush()
    return int(Status.OK)


def _start(arguments: Arguments, terminal: ConsoleTerminal) -> Status:
    registry = load_registry()
    if arguments.mode == "batch":
        return _run_batches(arguments, terminal, registry)
    runner = make_runner(arguments, terminal, registry)
    asks_for_help = not {"--help", "-h"}.isdisjoint(arguments.words)
    starts_tour = arguments.mode == "command" and arguments.words[0] == _TOUR and not asks_for_help
    if (arguments.mode == "prompt" or starts_tour) and sys.stdin.isatty():
        from maplab_py.console.prompt.loop import run_prompt

        return run_prompt(runner, shlex.join(arguments.words))
    if arguments.mode == "command":
        status = runner.run_words(arguments.words)
    elif arguments.mode == "commands":
        status = runner.run_script(arguments.text, keep_going=arguments.keep_going)
    elif arguments.mode == "run":
        texts = [read_script(path) for path in arguments.files]
        status = runner.run_script("\n".join(texts), keep_going=arguments.keep_going)
    else:
        status = runner.run_script(sys.stdin.read(), keep_going=arguments.keep_going)
    return runner.finish(status, discard=arguments.discard)


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
    from maplab_py.console.scripts.pipelines import run_as_pipeline, split_flags

    options, arguments.flags = split_flags(arguments.flags, registry.all_flags())
    given, _ = parse_words(arguments.flags, registry.all_flags(), "")
    folder = next((Path(g.text).expanduser() for g in given if g.name == _MAPS_FOLDER), None)
    batches = [read_batch(path, folder) for path in arguments.files]
    first = Status.OK
    for path, batch in zip(arguments.files, batches, strict=True):
        keep_going, discard = arguments.keep_going, arguments.discard
        if options is not None or batch.stages:
            session = make_runner(arguments, terminal, registry).session
            status = run_as_pipeline(
                batch,
                path,
                options or PipelineOptions(),
                session,
                terminal,
                keep_going=keep_going,
                discard=discard,
            )
        else:
            status = run_batch(
                batch,
                lambda: make_runner(arguments, terminal, registry),
                keep_going=keep_going,
                discard=discard,
            )
        first = first or status
        if status and not keep_going:
            break
    return first
