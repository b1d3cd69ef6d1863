"""Commands: plain functions whose keyword parameters are the flags."""

import dataclasses
import functools
import inspect
import re
import types
import typing
from collections.abc import Callable, Iterator, Mapping
from typing import Any, TypeVar

from maplab_py.console.commands.flag_types import flag_type
from maplab_py.console.commands.flags import COMMON_FLAGS, REQUIRED, Flag, normalise
from maplab_py.errors import FlagError
from maplab_py.options import help_of, unit_of

COMMAND_ATTRIBUTE = "maplab_command"

ValueSource = str | Callable[[Any], list[tuple[str, str]]]
"""Kind of a flag's values, or a function that returns values and notes for a session."""

FunctionT = TypeVar("FunctionT", bound=Callable[..., Any])


_OUTPUTS = (
    "save_map_folder",
    "rosbag_plugin_output_bag",
    "dense_result_mesh_output_file",
    "dense_esdf_export_map_for_panning_path",
    "csv_export_path",
    "summary_map_save_path",
    "pose_export_file",
    "mission_info_export_path",
    "ncamera_calibration_export_folder",
    "localization_csv",
    "colmap_folder",
    "colmap_workspace",
    "pmvs_reconstruction_folder",
    "dataset_folder",
    "sensors_file",
    "plot_file",
    "viewer_file",
    "output_file",
    "map_folder",
    "maps_folder",
    "bag",
    "apply",
    "csv",
    "file",
    "folder",
    "recording",
)
"""Flags that name what a command writes, maplab's names among them; a command has one of them at most."""
_USUAL_HELP = {
    "overwrite": "Replace files that exist.",
    "map_mission": "Mission id or unambiguous prefix; may be omitted if the map has only one.",
    "yes": "Do not ask for confirmation.",
    "plot_file": "File to write; the suffix gives the format.",
    "spool": "Folder of the spool.",
    "database": "Segment database.",
    "maps_folder": "Folder to search, with all sub-folders.",
}
"""Help of flags that mean the same in many commands, whose docstrings need not repeat it."""
_SENDERS = ("push", "simulate_robots", "play_recording")
"""Commands that act outside, with a flag of such a name for what they read."""


@dataclasses.dataclass(frozen=True, eq=False)
class Command:
    """A registered command: the function and what its signature and docstring say."""

    name: str
    aliases: tuple[str, ...]
    function: Callable[..., Any]
    summary: str
    description: str
    flags: Mapping[str, Flag]
    positional: tuple[str, ...]  # flags that may also be given by position
    variadic: bool  # takes any number of further words
    defaults: Mapping[str, Any]  # default option groups by parameter
    example: str = ""
    see_also: tuple[str, ...] = ()
    needs_map: bool = True
    raw_arguments: bool = False
    acts_outside: bool = False  # does something that dropping the draft of the maps does not undo
    writes_files: bool = False  # all that it does outside the maps is to write output files
    guards_effects: bool = False  # acts outside only inside `lasting_effect()`
    obeys_dry_run: bool = False  # acts outside, but not where `context.is_trial` is set
    completes: Mapping[str, ValueSource] = dataclasses.field(default_factory=dict)  # by flag
    reads: tuple[str, ...] = ()  # flags that name files or folders which must exist

    @property
    def output(self) -> str:
        """Flag that `-o` stands for, of the file or folder that the command writes; empty if none."""
        writes = self.writes_files or self.acts_outside or self.name == "lc_report"
        writes = writes and self.name not in _SENDERS
        outputs = (name for name in _OUTPUTS if writes and name in self.flags)
        return next((name for name in outputs if name not in self.reads), "")

    @property
    def names(self) -> tuple[str, ...]:
        """The name and all aliases."""
        return (self.name, *self.aliases)

    def bind(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Convert typed flag values into the function's keyword arguments.

        Raises:
            FlagError: A required flag is missing, or an option group refuses its values.
        """
        arguments: dict[str, Any] = {}
        changes: dict[str, dict[tuple[str, ...], Any]] = {}
        for flag in self.flags.values():
            parameter = flag.path[0]
            value = values.get(flag.name, REQUIRED)
            if len(flag.path) == 1:
                arguments[parameter] = flag.default if value is REQUIRED else value
                if arguments[parameter] is REQUIRED:
                    raise FlagError(f"{self.name} needs --{flag.name}=... ({flag.help})")
            elif value is not REQUIRED:
                changes.setdefault(parameter, {})[flag.path[1:]] = value
        for parameter, default in self.defaults.items():
            try:
                arguments[parameter] = _changed(default, changes.get(parameter, {}))
            except ValueError as error:
                raise FlagError(f"{self.name}: {error}") from None
        return arguments


def command(
    name: str,
    *aliases: str,
    example: str = "",
    see_also: tuple[str, ...] = (),
    needs_map: bool = True,
    raw_arguments: bool = False,
    acts_outside: bool = False,
    writes_files: bool = False,
    guards_effects: bool = False,
    obeys_dry_run: bool = False,
    completes: Mapping[str, ValueSource] | None = None,
    reads: tuple[str, ...] = (),
) -> Callable[[FunctionT], FunctionT]:
    """Register a function as a command of the console; the function is unchanged.

    The first parameter receives the `CommandContext`. Keyword-only parameters are flags; others
    are flags that may also be given by position, as may the only required flag; `*words: str` takes
    all further words. A parameter whose type is an options dataclass becomes one flag per field, named
    `flag_prefix` + field, or as the field's `flag` says. Flag help comes from `Args:`; usual flags such as
    `overwrite` have help without.

    Args:
        name: maplab's name of the command.
        aliases: Short names.
        example: One line that can be typed as it is.
        see_also: Related commands for the help page.
        needs_map: The command needs a selected map.
        raw_arguments: The words behind the command go to `*words` unread, flags included.
        acts_outside: The command changes the session, or files in a way of its own. Then Ctrl-C
            waits for it, and --dry_run is refused unless the command obeys it.
        writes_files: All that the command does outside the maps is to write files through
            `maplab_py.output_files`. They appear together when it ends well, none when it fails or
            is cancelled; --dry_run tells which files it would write.
        guards_effects: The command acts outside, too, but only inside `lasting_effect()`. Ctrl-C
            then waits only while it is in such a block.
        obeys_dry_run: The command acts outside, but where `context.is_trial` is set it only checks
            and returns a report of what it would do.
        completes: Values that the prompt proposes, by flag: "snapshot", "job", "alias", "map",
            "mission", "command", or a function of the session that returns pairs of a value and a
            note on it.
        reads: Flags that name files or folders which must exist, or maps in memory. A script is not
            started when one is missing that no command before it can have made.

    Raises:
        TypeError: The signature cannot be a command: a type that no flag can have, or the same
            flag twice.
    """

    def decorate(function: FunctionT) -> FunctionT:
        described = describe(
            function,
            name,
            aliases,
            example=example,
            see_also=see_also,
            needs_map=needs_map,
            raw_arguments=raw_arguments,
            acts_outside=acts_outside or guards_effects,
            writes_files=writes_files,
            guards_effects=guards_effects,
            obeys_dry_run=obeys_dry_run,
            completes=dict(completes or {}),
            reads=reads,
        )
        setattr(function, COMMAND_ATTRIBUTE, described)
        return function

    return decorate


def describe(
    function: Callable[..., Any], name: str, aliases: tuple[str, ...], **settings: Any
) -> Command:
    """Read a function's signature and docstring into a `Command`."""
    documentation = parse_docstring(function)
    if not documentation.summary:
        raise TypeError(f"command {name}: the function has no docstring to serve as help")
    parameters = list(inspect.signature(function).parameters.values())[1:]
    hints = parameter_hints(function, [parameter.name for parameter in parameters])
    flags: dict[str, Flag] = {}
    positional: list[str] = []
    defaults: dict[str, Any] = {}
    variadic = False
    for parameter in parameters:
        if parameter.kind is parameter.VAR_POSITIONAL:
            variadic = True
            continue
        if parameter.kind is parameter.VAR_KEYWORD or parameter.name not in hints:
            raise TypeError(f"command {name}: parameter {parameter.name} needs a type")
        for flag in _flags_of(parameter, hints[parameter.name], documentation.arguments):
            if flag.name in flags or flag.name in COMMON_FLAGS:
                raise TypeError(f"command {name}: flag --{flag.name} is defined twice")
            flags[flag.name] = flag
        if _is_options(hints[parameter.name]):
            defaults[parameter.name] = _default_group(parameter, hints[parameter.name])
        elif parameter.kind is parameter.POSITIONAL_OR_KEYWORD:
            positional.append(normalise(parameter.name).rstrip("_"))
    required = [flag.name for flag in flags.values() if flag.is_required]
    if not positional and not variadic and len(required) == 1:
        positional = required
    described = Command(
        name,
        aliases,
        function,
        documentation.summary,
        documentation.description,
        types.MappingProxyType(flags),
        tuple(positional),
        variadic,
        defaults,
        **settings,
    )
    if described.example or any(flag.is_required for flag in flags.values()):
        return described
    return dataclasses.replace(described, example=name)


def parameter_hints(function: Callable[..., Any], names: list[str]) -> dict[str, Any]:
    """Evaluate the annotations of flags; other types may be known to type checkers alone."""
    annotations = function.__annotations__
    wanted = {name: annotations[name] for name in names if name in annotations}
    holder = types.SimpleNamespace(__annotations__=wanted)
    namespace = getattr(function, "__globals__", {})
    return typing.get_type_hints(holder, globalns=namespace, localns=namespace)


def _flags_of(
    parameter: inspect.Parameter, hint: Any, documentation: Mapping[str, str]
) -> Iterator[Flag]:
    if _is_options(hint):
        default = parameter.default
        yield from (
            _default_flags(hint, parameter.name)
            if default is parameter.empty
            else _group_flags(default, (parameter.name,))
        )
        return
    yield Flag(
        normalise(parameter.name).rstrip("_"),
        flag_type(hint),
        REQUIRED if parameter.default is parameter.empty else parameter.default,
        documentation.get(parameter.name) or _USUAL_HELP.get(parameter.name, ""),
        path=(parameter.name,),
    )


@functools.cache
def _default_flags(group: type, parameter: str) -> tuple[Flag, ...]:
    """Return the flags of an options dataclass with its own defaults; many commands share one."""
    return tuple(_group_flags(group(), (parameter,)))


def _group_flags(group: Any, path: tuple[str, ...]) -> Iterator[Flag]:
    """Yield one flag per field of an options dataclass, those of nested groups included."""
    prefix = getattr(group, "flag_prefix", "")
    hints = _field_types(group.__class__)
    for field in dataclasses.fields(group):
        value = getattr(group, field.name)
        if _is_options(hints[field.name]):
            yield from _group_flags(value, (*path, field.name))
            continue
        yield Flag(
            field.metadata.get("flag") or prefix + field.name,
            flag_type(hints[field.name], field.metadata.get("choices", ())),
            value,
            functools.partial(help_of, group.__class__, field),
            unit_of(field),
            (*path, field.name),
        )


@functools.cache
def _field_types(group: type) -> dict[str, Any]:
    return typing.get_type_hints(group)


def _is_options(hint: Any) -> bool:
    return isinstance(hint, type) and dataclasses.is_dataclass(hint)


def _default_group(parameter: inspect.Parameter, hint: Any) -> Any:
    return hint() if parameter.default is parameter.empty else parameter.default


def _changed(group: Any, changes: Mapping[tuple[str, ...], Any]) -> Any:
    """Return an options dataclass with some (nested) fields exchanged."""
    fields = {path[0]: value for path, value in changes.items() if len(path) == 1}
    nested: dict[str, dict[tuple[str, ...], Any]] = {}
    for path, value in changes.items():
        if len(path) > 1:
            nested.setdefault(path[0], {})[path[1:]] = value
    for name, inner in nested.items():
        fields[name] = _changed(getattr(group, name), inner)
    return dataclasses.replace(group, **fields) if fields else group


_SECTION = re.compile(r"^(Args|Returns|Raises|Examples?|Yields|Note|Notes):\s*$")
_ARGUMENT = re.compile(r"^ {2,8}\*{0,2}(\w+)(?: \([^)]*\))?:\s*(.*)$")


@dataclasses.dataclass(frozen=True)
class Documentation:
    """A docstring taken apart."""

    summary: str
    description: str
    arguments: Mapping[str, str]


def parse_docstring(function: Callable[..., Any]) -> Documentation:
    """Take the docstring of a function apart (Google style)."""
    lines = (inspect.getdoc(function) or "").splitlines()
    prose: list[str] = []
    arguments: dict[str, str] = {}
    section = ""
    name = ""
    for line in lines:
        heading = _SECTION.match(line)
        if heading:
            section, name = heading.group(1), ""
            continue
        if not section:
            prose.append(line)
            continue
        if section != "Args":
            continue
        entry = _ARGUMENT.match(line)
        if entry:
            name = entry.group(1)
            arguments[name] = entry.group(2).strip()
        elif name and line.strip():
            arguments[name] += " " + line.strip()
    summary, _, description = "\n".join(prose).strip().partition("\n\n")
    return Documentation(" ".join(summary.split()), description.strip(), arguments)
