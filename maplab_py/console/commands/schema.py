"""JSON schemas of reports, derived from the types of their fields; the output of --json follows them."""

import ast
import collections.abc
import dataclasses
import functools
import inspect
import pkgutil
import sys
import threading
import types
import typing
from collections.abc import Callable
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.cancellation import check_cancelled
from maplab_py.console.commands.command import Command
from maplab_py.report import SCHEMA_VERSION, Message, Report

DIALECT = "https://json-schema.org/draft/2020-12/schema"
_SCALARS: dict[Any, Any] = {
    bool: {"type": "boolean"},
    int: {"type": "integer"},
    float: {"type": ["number", "null"]},  # null where the number is not finite
    str: {"type": "string"},
    Path: {"type": "string"},
    type(None): {"type": "null"},
    Any: {},
    object: {},
}


def line_schema(commands: list[Command]) -> dict[str, Any]:
    """Return the schema of one line of output: what all commands have in common, and each report."""
    definitions: dict[str, Any] = {}
    reports = {}
    for command in commands:
        check_cancelled()
        kinds = report_types(command.function)
        schemas = [_schema(kind, definitions) for kind in kinds]
        reports[command.name] = schemas[0] if len(schemas) == 1 else {"anyOf": schemas}
    return {
        "$schema": DIALECT,
        "$id": f"maplab-report-{SCHEMA_VERSION}",
        "title": "One line of what maplab --json prints",
        "type": "object",
        "properties": {
            "schema": {"const": SCHEMA_VERSION},
            "command": {"type": "string"},
            "status": {"enum": [0, 1, 2, 130]},
            "error": {"type": ["string", "null"]},
            "seconds": {"type": ["number", "null"]},
            "report": {"type": ["object", "null"]},
        },
        "required": ["schema", "command", "status", "error", "seconds", "report"],
        "additionalProperties": False,
        "allOf": [
            {
                "if": {"properties": {"command": {"const": name}}},
                "then": {"properties": {"report": {"anyOf": [report, {"type": "null"}]}}},
            }
            for name, report in reports.items()
        ],
        "$defs": definitions,
    }


def report_types(function: Callable[..., Any]) -> tuple[type[Report], ...]:
    """Return the report classes that a command's return annotation names.

    Raises:
        TypeError: There is no annotation, or it is no concrete report class.
    """
    annotation = inspect.signature(function).return_annotation
    hint = _evaluate(annotation, sys.modules[function.__module__])
    kinds = typing.get_args(hint) if _is_union(hint) else (hint,)
    reports = tuple(Message if kind in (str, type(None), None) else kind for kind in kinds)
    for kind in reports:
        if not (isinstance(kind, type) and issubclass(kind, Report)) or kind is Report:
            raise TypeError(f"{function.__name__} must say which reports it returns, not {kind}")
    return reports


def _schema(hint: Any, definitions: dict[str, Any]) -> dict[str, Any]:
    if isinstance(hint, typing.NewType):
        hint = hint.__supertype__
    if hint in _SCALARS:
        return dict(_SCALARS[hint])
    if _is_union(hint):
        return {"anyOf": [_schema(kind, definitions) for kind in typing.get_args(hint)]}
    origin, arguments = typing.get_origin(hint) or hint, typing.get_args(hint)
    if origin is typing.Literal:
        return {"enum": list(arguments)}
    if origin is typing.Annotated:
        return _schema(arguments[0], definitions)
    if isinstance(origin, type):
        return _class_schema(origin, arguments, definitions)
    raise TypeError(f"no schema for {hint}")


def _class_schema(
    kind: type, arguments: tuple[Any, ...], definitions: dict[str, Any]
) -> dict[str, Any]:
    if kind is Report:
        return {"type": "object"}
    if dataclasses.is_dataclass(kind):
        return _record_schema(kind, definitions)
    if issubclass(kind, np.ndarray):
        return {"type": ["array", "number"]}
    if issubclass(kind, np.generic):
        return {"type": ["number", "boolean", "null"]}
    if issubclass(kind, Enum):
        return {"enum": [member.name.lower() for member in kind]}
    if issubclass(kind, (dict, collections.abc.Mapping)):
        inner = _schema(arguments[1], definitions) if arguments else {}
        return {"type": "object", "additionalProperties": inner}
    if issubclass(kind, tuple) and arguments and arguments[-1] is not Ellipsis:
        items = [_schema(argument, definitions) for argument in arguments]
        return {"type": "array", "prefixItems": items, "minItems": len(items), "items": False}
    if issubclass(kind, (list, tuple, set, frozenset, collections.abc.Sequence)):
        return {"type": "array", "items": _schema(arguments[0], definitions) if arguments else {}}
    raise TypeError(f"no schema for {kind}")


def _record_schema(kind: type, definitions: dict[str, Any]) -> dict[str, Any]:
    name = kind.__name__
    taken = definitions.get(name)
    if taken is not None and taken["$comment"] != kind.__module__:
        name = f"{kind.__module__}.{name}"
    if name not in definitions:
        definitions[name] = {"$comment": kind.__module__}  # a report may contain its like
        hints = _field_hints(kind)
        names = [field.name for field in dataclasses.fields(kind)]
        definitions[name] |= {
            "description": (inspect.getdoc(kind) or "").split("\n\n")[0].replace("\n", " "),
            "type": "object",
            "properties": {n: _schema(hints[n], definitions) for n in names},
            "required": names,
            "additionalProperties": False,
        }
    return {"$ref": f"#/$defs/{name}"}


def _field_hints(kind: type) -> dict[str, Any]:
    hints: dict[str, Any] = {}
    for base in reversed(kind.__mro__):
        module = sys.modules[base.__module__]
        for name, annotation in vars(base).get("__annotations__", {}).items():
            hints[name] = _evaluate(annotation, module)
    return hints


def _evaluate(annotation: Any, module: types.ModuleType) -> Any:
    """Evaluate an annotation, also where its names are imported for type checkers only."""
    if not isinstance(annotation, str):
        return annotation
    holder = types.SimpleNamespace(__annotations__={"it": annotation})
    names = _Names(module)
    return typing.get_type_hints(holder, globalns=names, localns=names, include_extras=True)["it"]


class _Names(dict[str, Any]):
    """The names of a module, those that it imports for type checkers included."""

    def __init__(self, module: types.ModuleType) -> None:
        super().__init__(vars(module))
        self._module = module

    def __missing__(self, name: str) -> Any:
        module, original = _imported_names(self._module)[name]
        return pkgutil.resolve_name(f"{module}.{original}")


_PARSING = threading.Lock()


@functools.cache
def _imported_names(module: types.ModuleType) -> dict[str, tuple[str, str]]:
    """Return what a module's source imports by `from`: module and name there, by the name here.

    Two threads must not parse at a time (an abandoned command's may go on): Python 3.11 counts the
    depth of syntax trees for both together, and fails with a SystemError.
    """
    with _PARSING:
        tree = ast.parse(inspect.getsource(module))
    return {
        alias.asname or alias.name: (node.module, alias.name)
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module
        for alias in node.names
    }


def _is_union(hint: Any) -> bool:
    return typing.get_origin(hint) in (typing.Union, types.UnionType)
