"""The program `maplab`: reads its command line and starts what it asks for."""

import atexit
import contextlib
import dataclasses
import os
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from maplab_py import child_processes, kernel_cache
from maplab_py.console.commands.flag_types import expand_path
from maplab_py.console.commands.flags import looks_like_flag, normalise, parse_words
from maplab_py.console.commands.registry import Registry, load_registry
from maplab_py.console.scripts.aliases import read_aliases
from maplab_py.console.scripts.batch import read_batch, read_script, run_batch
from maplab_py.console.scripts.runner import Runner
from maplab_py.console.session import log, paths, settings
from maplab_py.console.session.session import Session
from maplab_py.console.session.status import Status
from maplab_py.console.terminal import foreground, streams
from maplab_py.console.terminal.output import ConsoleTerminal
from maplab_py.errors import FlagError, MaplabError, UserError
from maplab_py.pipeline.options import PipelineOptions

SWITCHES = ("json", "keep_going", "discard", "help", "version")

USAGE = """\
usage: maplab [FLAGS]                     the console; reads commands from standard input if piped
       maplab -c "COMMAND; COMMAND; ..."  run commands
       maplab run SCRIPT... [FLAGS]       run files of commands
       maplab batch FILE.yaml [FLAGS]     run commands on each of several map folders, or the
                                     stages of a pipeline; its flags: see below
       maplab COMMAND [COMMAND'S FLAGS]   run one command
       maplab tour                        learn the console in ten minutes

  --flagfile=FILE  flags for all commands, one per line (also any command's --flag=value)
  --json           print each report as one line of JSON on standard output
  --keep_going     do not stop at the first command that fails
  --discard        leave without saving what has changed
  --version        print the version

Flags of 'maplab batch': --scheduler=none | local:N | tcp://HOST:PORT, --retries=N, --resume
(keep what is finished), --redo_changed, --restart, --results_folder=DIR, --task_memory_gb=N,
--task_threads=N

'maplab help' lists the commands, 'maplab help COMMAND' explains one.
Exit status: 0 done, 1 a command failed, 2 wrong usage, 130 cancelled."""


@dataclasses.dataclass
class Arguments:
    """The parsed command line of the program."""

    mode: str = "prompt"  # prompt, commands, run, batch, command
    text: str = ""  # of -c
    files: list[Path] = dataclasses.field(default_factory=list)
    words: list[str] = dataclasses.field(default_factory=list)  # of a single command
    flagfiles: list[Path] = dataclasses.field(default_factory=list)
    flags: list[str] = dataclasses.field(default_factory=list)  # lasting flags of commands
    json: bool = False
    keep_going: bool = False
    discard: bool = False
    help: bool = False
    version: bool = False


def parse_arguments(argv: Sequence[str]) -> Arguments:
    """Read the program's command line (without the program's name).

    Raises:
        FlagError: -c, run or batch lacks what it runs, or a flag file is not named.
    """
    arguments = Arguments()
    rest = list(argv)
    while rest:
        word = rest.pop(0)
        name, has_value, value = normalise(word.lstrip("-")).partition("=")
        if arguments.mode == "command":
            _take_command_word(arguments, word, name)
        elif word == "-c":
            if arguments.mode in ("run", "batch"):
                raise FlagError(f"-c cannot stand beside {arguments.mode} (see: maplab --help)")
            commands = [arguments.text, _next(rest, "-c needs the commands to run")]
            arguments.mode, arguments.text = "commands", "; ".join(filter(None, commands))
        elif word == "-h" or (looks_like_flag(word) and name in SWITCHES and not has_value):
            setattr(arguments, "help" if word == "-h" else name, True)
        elif looks_like_flag(word) and name == "flagfile":
            text = word.partition("=")[2] if value else _next(rest, "--flagfile needs a path")
            arguments.flagfiles.append(_path(text))
        elif looks_like_flag(word):
            arguments.flags.append(word)
            if not has_value and rest and not looks_like_flag(rest[0]):
                arguments.flags.append(rest.pop(0))
        elif arguments.mode in ("run", "batch"):
            arguments.files.append(_path(word))
        elif arguments.mode == "prompt":
            arguments.mode = word if word in ("run", "batch") else "command"
            arguments.words = [word]
        else:
            raise FlagError(f"unexpected word '{word}' after -c (see: maplab --help)")
    if arguments.mode in ("run", "batch") and not arguments.files:
        raise FlagError(f"maplab {arguments.mode} needs a file")
    return arguments


def _take_command_word(arguments: Arguments, word: str, name: str) -> None:
    """Pass words on to a single command, except the switches of the program."""
    if looks_like_flag(word) and name in SWITCHES and name != "help":
        setattr(arguments, name, True)
    else:
        arguments.words.append(word)


def _next(rest: list[str], message: str) -> str:
    if not rest:
        raise FlagError(message)
    return rest.pop(0)


def _path(text: str) -> Path:
    try:
        path = expand_path(text)
    except ValueError as error:
        raise FlagError(f"{text}: {error}") from None
    if path is None:
        raise FlagError("an empty path was given")
    return path


_MAPS_FOLDER = "maps_folder"
_TOUR = "tour"
"""The command that goes on at the prompt when the program is started with it."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the console and return its exit status.

    Args:
        argv: Words behind the program's name. When they are not given, those of the process are
            taken, and the process ends here if an abandoned command still runs.
    """
    child_processes.end_with_parent()
    streams.open_closed_streams()
    status = _main(sys.argv[1:] if argv is None else argv)
    if argv is None and foreground.abandoned_commands_run():
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
        log.start_logging()
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
    except streams.PipeClosed:
        return streams.PIPE_STATUS
    except streams.OutputError as error:
        terminal.error(str(error))
        return int(Status.FAILED)


def _print_about(arguments: Arguments) -> int:
    if arguments.version:
        from importlib.metadata import version

        text = f"maplab-py {version('maplab-py')}"
    else:
        text = USAGE
    with streams.writing_output():
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
    if paths.user_flagfile().is_file():
        try:
            session.settings.assign_file(paths.user_flagfile(), settings.Layer.USER_CONFIG)
        except FlagError as error:
            terminal.warning(str(error))
    try:
        session.aliases.update(read_aliases(paths.user_aliases()))
    except UserError as error:
        terminal.warning(str(error))
    for path in arguments.flagfiles:
        session.settings.assign_file(path, settings.Layer.START_UP)
    session.settings.assign(arguments.flags, settings.Layer.START_UP, "start-up")
    return Runner(session, terminal)


def _run_batches(arguments: Arguments, terminal: ConsoleTerminal, registry: Registry) -> Status:
    from maplab_py.console.scripts.pipelines import run_as_pipeline, split_flags

    known = registry.all_flags() if arguments.flags else {}
    options, arguments.flags = split_flags(arguments.flags, known)
    given, _ = parse_words(arguments.flags, known, "")
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
