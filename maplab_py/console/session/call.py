"""One call of a command: from words or keyword arguments to typed values with their origins."""

import dataclasses
from collections import ChainMap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from maplab_py.console.commands import flag_types, flags, suggest
from maplab_py.console.commands.command import Command
from maplab_py.console.commands.registry import Registry
from maplab_py.console.session.settings import Settings
from maplab_py.errors import FlagError, UserError

_SHELL_SEPARATORS = ("&&", "||", "&", "|")


@dataclasses.dataclass(frozen=True)
class Call:
    """A command with everything it needs to run."""

    command: Command
    values: Mapping[str, Any]  # by flag
    words: tuple[str, ...] = ()  # for *words
    given: Mapping[str, str] = dataclasses.field(default_factory=dict)  # typed for this call
    wants_help: bool = False
    keeps_flags: bool = False
    verbosity: int = 0
    is_trial: bool = False  # changes of the maps are discarded
    max_memory_gb: float = 0.0  # 0 = most of what is available

    def arguments(self) -> dict[str, Any]:
        """Return the keyword arguments of the command's function."""
        return self.command.bind(self.values)


def call_from_words(words: Sequence[str], registry: Registry, settings: Settings) -> Call:
    """Read the words of one command line.

    Precedence: default < lasting settings < the command's flag file < the command's own words.

    Raises:
        UserError: The command is unknown.
        FlagError: A flag is unknown, has no value or an invalid one.
    """
    command = registry.find(words[0])
    if command.raw_arguments:
        wants_help = list(words[1:]) == ["--help"]
        return Call(command, {}, () if wants_help else tuple(words[1:]), {}, wants_help)
    given, plain = flags.parse_words(_with_output(words[1:], command), command.flags, command.name)
    common = {g.name: g.text for g in given if g.name not in command.flags}
    texts: dict[str, str] = {}
    for path in (g.text for g in given if g.name == "flagfile"):
        texts.update(_flagfile_texts(path, command, registry))
    typed = {g.name: g.text for g in given if g.name in command.flags}
    placed, rest = _place(plain, command, typed)
    texts.update(typed | placed)
    lasting = {name: setting.text for name, setting in settings.for_command(command).items()}
    wants_help = common.get("help") == "true"
    values = {} if wants_help else {n: command.flags[n].convert(t) for n, t in texts.items()}
    for name, text in lasting.items() if not wants_help else ():
        if name not in values:
            values[name] = command.flags[name].convert(text)
    return Call(
        command,
        values,
        tuple(rest),
        texts,
        wants_help,
        common.get("keep_gflags") == "true",
        _verbosity(common.get("v", "0"), command),
        common.get("dry_run") == "true" and _may_be_tried(command),
        _max_memory_gb(common.get("max_memory_gb", "0"), command),
    )


def call_from_keywords(
    command: Command, words: Sequence[str], keywords: Mapping[str, Any], settings: Settings
) -> Call:
    """Make a call from Python values; an options dataclass may be given as a whole.

    Raises:
        FlagError: A keyword is not a flag of the command, or its value does not fit.
    """
    values: dict[str, Any] = {}
    for name, setting in settings.for_command(command).items():
        values[name] = command.flags[name].convert(setting.text)
    for keyword, value in keywords.items():
        if keyword in command.defaults:
            values.update(_group_values(command, keyword, value))
    for keyword, value in keywords.items():
        name = flags.normalise(keyword).rstrip("_")
        if keyword in command.defaults or name in ("dry_run", "max_memory_gb"):
            continue
        if name not in command.flags:
            known = [*command.flags, *command.defaults]
            proposal = flags.explanation(name) or suggest.did_you_mean(name, known, "--")
            raise FlagError(f"{command.name} has no flag --{name}{proposal}")
        values[name] = command.flags[name].convert(value)
    placed, rest = _place(list(words), command, {})
    values.update({name: command.flags[name].convert(text) for name, text in placed.items()})
    return Call(
        command,
        values,
        tuple(rest),
        is_trial=bool(keywords.get("dry_run")) and _may_be_tried(command),
        max_memory_gb=_max_memory_gb(str(keywords.get("max_memory_gb", "0")), command),
    )


def _with_output(words: Sequence[str], command: Command) -> list[str]:
    """Return the words with the flag of the command's output in place of `-o`.

    Raises:
        FlagError: The command writes no file or folder.
    """
    is_output = [word == "-o" or word.startswith("-o=") for word in words]
    if any(is_output) and not command.output:
        raise FlagError(f"{command.name} writes no file: it has no -o")
    return [
        f"--{command.output}{word[2:]}" if is_flag else word
        for word, is_flag in zip(words, is_output, strict=True)
    ]


def _may_be_tried(command: Command) -> bool:
    """Return True if a dry run of the command has no effect.

    Raises:
        FlagError: The command acts outside the maps in memory.
    """
    if command.acts_outside and not command.obeys_dry_run:
        raise FlagError(f"{command.name} acts outside the maps in memory: it has no --dry_run")
    return True


def _group_values(command: Command, parameter: str, group: Any) -> dict[str, Any]:
    if type(group) is not type(command.defaults[parameter]):
        wanted = type(command.defaults[parameter]).__name__
        raise FlagError(f"{command.name}: {parameter} must be a {wanted}")
    values = {}
    for flag in command.flags.values():
        if flag.path[0] == parameter:
            value = group
            for field in flag.path[1:]:
                value = getattr(value, field)
            values[flag.name] = value
    return values


def _place(
    plain: list[str], command: Command, typed: Mapping[str, str]
) -> tuple[dict[str, str], list[str]]:
    """Assign plain words to the positional flags; the rest goes to *words."""
    placed: dict[str, str] = {}
    rest = list(plain)
    for name in command.positional:
        if not rest:
            break
        if name in typed:
            continue
        placed[name] = rest.pop(0)
    if rest and not command.variadic:
        flag = next((f for f in command.flags.values() if not f.type.is_bool), None)
        form = f" (flags are written --{flag.name}=value)" if flag else ""
        if rest[0] in _SHELL_SEPARATORS:
            form = " (commands are separated by ;)"
        raise FlagError(f"{command.name}: unexpected word '{rest[0]}'{form}")
    return placed, rest


def _flagfile_texts(text: str, command: Command, registry: Registry) -> dict[str, str]:
    """Return the flags of a flag file for this command; flags of other commands are skipped."""
    try:
        path = flag_types.expand_path(text)
    except ValueError as error:
        raise FlagError(f"--flagfile={text}: {error}") from None
    known: Mapping[str, flags.Flag] = ChainMap(dict(command.flags), registry.all_flags())  # type: ignore[arg-type]
    texts: dict[str, str] = {}
    for line in flags.read_flagfile(path or Path()):
        try:
            given, plain = flags.parse_words(line.words, known, command.name)
            if plain:
                raise FlagError(f"'{plain[0]}' is not a flag (write --name=value)")
            texts.update(_check(given, command))
        except UserError as error:
            raise FlagError(f"{line.origin}: {error}") from None
    return texts


def _check(given: Sequence[flags.Given], command: Command) -> dict[str, str]:
    texts = {g.name: g.text for g in given if g.name in command.flags}
    for name, text in texts.items():
        command.flags[name].convert(text)
    return texts


def _max_memory_gb(text: str, command: Command) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 <= value < float("inf"):
        raise FlagError(f"{command.name}: --max_memory_gb={text}: must be a number of gigabytes")
    return value


def _verbosity(text: str, command: Command) -> int:
    try:
        return int(text)
    except ValueError:
        raise FlagError(f"{command.name}: --v={text}: wants a whole number") from None
