"""Commands: plain functions whose keyword parameters are the flags."""

from __future__ import annotations

import dataclasses
import inspect
import types
import typing
from collections.abc import Callable, Iterator, Mapping
from typing import Any, TypeVar

from maplab_py.console.docstrings import parse_docstring
from maplab_py.console.flag_types import flag_type
from maplab_py.console.flags import COMMON_FLAGS, REQUIRED, Flag, normalise
from maplab_py.errors import FlagError

COMMAND_ATTRIBUTE = "maplab_command"

_RESERVED = tuple(name for name in COMMON_FLAGS if name != "dry_run")

FunctionT = TypeVar("FunctionT", bound=Callable[..., Any])


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

    @property
    def names(self) -> tuple[str, ...]:
        """The name and all aliases."""
        return (self.name, *self.aliases)

    def bind(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Turn flag values (typed) into the function's keyword arguments.

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
) -> Callable[[FunctionT], FunctionT]:
    """Make a function a command of the console; the function itself stays as it is.

    The first parameter receives the `CommandContext`. Keyword-only parameters are flags; others
    are flags that may also be given by position; `*words: str` takes all further words. A
    parameter whose type is an options dataclass becomes one flag per field, named
    `flag_prefix` + field, or as the field's `flag` says. Flag help comes from `Args:`.

    Args:
        name: maplab's name of the command.
        aliases: Short names.
        example: One line that can be typed as it is.
        see_also: Related commands for the help page.
        needs_map: The command is refused while no map is selected.
        raw_arguments: The words behind the command go to `*words` unread, flags included.
        acts_outside: The command changes the session, or files in a way of its own. Then it is
            never left behind half done by Ctrl-C, and has --dry_run only if it defines that flag.
        writes_files: All that the command does outside the maps is to write files through
            `maplab_py.output_files`. It is never left behind half done either; --dry_run tells
            which files it would write.

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
            acts_outside=acts_outside,
            writes_files=writes_files,
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
    hints = _parameter_hints(function)
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
            if flag.name in flags or flag.name in _RESERVED:
                raise TypeError(f"command {name}: flag --{flag.name} is defined twice")
            flags[flag.name] = flag
        if _is_options(hints[parameter.name]):
            defaults[parameter.name] = _default_group(parameter, hints[parameter.name])
        elif parameter.kind is parameter.POSITIONAL_OR_KEYWORD:
            positional.append(normalise(parameter.name).rstrip("_"))
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


def _parameter_hints(function: Callable[..., Any]) -> dict[str, Any]:
    """Evaluate the parameters' annotations only: a return type may be known to checkers alone."""
    first = next(iter(inspect.signature(function).parameters), "")
    wanted = {
        name: annotation
        for name, annotation in function.__annotations__.items()
        if name not in ("return", first)
    }
    holder = types.SimpleNamespace(__annotations__=wanted)
    namespace = getattr(function, "__globals__", {})
    return typing.get_type_hints(holder, globalns=namespace, localns=namespace)


def _flags_of(
    parameter: inspect.Parameter, hint: Any, documentation: Mapping[str, str]
) -> Iterator[Flag]:
    if _is_options(hint):
        yield from _group_flags(_default_group(parameter, hint), (parameter.name,))
        return
    yield Flag(
        normalise(parameter.name).rstrip("_"),
        flag_type(hint),
        REQUIRED if parameter.default is parameter.empty else parameter.default,
        documentation.get(parameter.name, ""),
        path=(parameter.name,),
    )


def _group_flags(group: Any, path: tuple[str, ...]) -> Iterator[Flag]:
    """Yield one flag per field of an options dataclass, those of nested groups included."""
    prefix = getattr(group, "flag_prefix", "")
    hints = typing.get_type_hints(type(group))
    for field in dataclasses.fields(group):
        value = getattr(group, field.name)
        if _is_options(hints[field.name]):
            yield from _group_flags(value, (*path, field.name))
            continue
        yield Flag(
            field.metadata.get("flag") or prefix + field.name,
            flag_type(hints[field.name], field.metadata.get("choices", ())),
            value,
            field.metadata.get("help", ""),
            field.metadata.get("unit", ""),
            (*path, field.name),
        )


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
