"""The program's own command line, before any console command."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from maplab_py.console.commands.flag_types import expand_path
from maplab_py.console.commands.flags import looks_like_flag, normalise
from maplab_py.errors import FlagError

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
