"""Reports: results of an algorithm as small dataclasses of numbers that a user would ask for."""

import dataclasses
import functools
import html
import inspect
import json
from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from typing import Any, ClassVar, dataclass_transform

import numpy as np

SCHEMA_VERSION = 1
"""Version of the JSON that --json prints; it rises when a field changes its meaning or goes."""


@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field,))
class Report:
    """Base of every report: makes each a frozen dataclass; fields are the facts.

    A report that describes a failure (an inconsistent map, an empty result) overrides `failure`:
    the console then prints the report and the command's status is 1.
    """

    __dataclass_fields__: ClassVar[dict[str, dataclasses.Field[Any]]]

    def __init_subclass__(cls) -> None:
        dataclasses.dataclass(frozen=True)(cls)
        # plugins may decorate their reports, too: the decorator must not see that this was done
        del cls.__setattr__, cls.__delattr__
        for name in inspect.get_annotations(cls):
            field = cls.__dataclass_fields__.get(name)
            if field is not None and field.default_factory is not dataclasses.MISSING:
                setattr(cls, name, field)

    def __setattr__(self, name: str, value: object) -> None:
        raise dataclasses.FrozenInstanceError(f"cannot assign to field {name!r}")

    def __delattr__(self, name: str) -> None:
        raise dataclasses.FrozenInstanceError(f"cannot delete field {name!r}")

    @property
    def failure(self) -> str:
        """One line that says why the command failed although it ran; empty when it succeeded."""
        return ""

    @property
    def remedy(self) -> str:
        """Command line after which a command that failed can be run again; empty if none is known."""
        return ""

    @property
    def advice(self) -> str:
        """One line on what to do next, empty where nothing is known; the prompt shows it."""
        return ""

    def as_text(self) -> str | None:
        """Return the report as people shall read it; None lets the console lay out the fields."""
        return None

    @property
    def is_verbatim(self) -> bool:
        """Whether the lines of `as_text` stay whole on a narrow terminal, so that they can be copied."""
        return False

    def display(self) -> Any:
        """Return the dataclass that the console lays out: the report, or one with less detail."""
        return self

    def as_dict(self) -> dict[str, Any]:
        """Return the report's fields as plain JSON types."""
        return {f.name: to_json(getattr(self, f.name)) for f in dataclasses.fields(self)}

    def as_json(self, indent: int | None = None) -> str:
        """Return the report's fields as JSON text.

        Args:
            indent: Spaces of each level; None = one line.
        """
        return json.dumps(self.as_dict(), indent=indent, ensure_ascii=False)

    def _repr_html_(self) -> str:
        """Return the report as tables, for notebooks."""
        shown = self.display()
        text = self.as_text()
        if text is None and isinstance(shown, Report):
            text = shown.as_text()
        return f"<pre>{html.escape(text)}</pre>" if text is not None else to_html(to_json(shown))


class Message(Report):
    """A report of one sentence."""

    text: str

    def as_text(self) -> str:
        """Return the sentence."""
        return self.text


@functools.cache
def _view_type(names: tuple[str, ...], headings: tuple[tuple[str, str], ...]) -> type[Any]:
    metadata = {name: {"title": text} for name, text in headings} | {"summary": {"is_prose": True}}
    fields = [(name, Any, dataclasses.field(metadata=metadata.get(name))) for name in names]
    return dataclasses.make_dataclass("View", fields, frozen=True)


def view(headings: Mapping[str, str] | None = None, /, **values: Any) -> Any:
    """Return values as a dataclass for `Report.display`; a `summary` is shown as a sentence.

    Args:
        headings: Headings of fields, instead of those that follow from their names; empty = none.
        values: The values by name, in the order in which they are shown.
    """
    return _view_type(tuple(values), tuple((headings or {}).items()))(**values)


def counted(count: int, singular: str, plural: str = "") -> str:
    """Return a number with its noun: 1 map, 2 maps, 3 vertices."""
    return f"{count} {singular if count == 1 else plural or singular + 's'}"


def to_json(value: Any) -> Any:
    """Convert dataclasses, numpy values, paths and enums to plain JSON types."""
    if isinstance(value, Report):
        return value.as_dict()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: to_json(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, np.ndarray):
        return to_json(value.tolist())
    if isinstance(value, np.generic):
        return to_json(value.item())
    if isinstance(value, Mapping):
        return {str(key): to_json(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [to_json(item) for item in value]
    if isinstance(value, Enum):
        return value.name.lower()
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def to_html(value: Any) -> str:
    """Write plain JSON types as HTML: objects and lists of objects as tables."""
    if isinstance(value, dict):
        rows = (
            f"<tr><th>{html.escape(k)}</th><td>{to_html(v)}</td></tr>" for k, v in value.items()
        )
        return f"<table>{''.join(rows)}</table>"
    if isinstance(value, list) and value and all(isinstance(item, dict) for item in value):
        names = list(value[0])
        head = "".join(f"<th>{html.escape(name)}</th>" for name in names)
        rows = ("".join(f"<td>{to_html(item.get(name))}</td>" for name in names) for item in value)
        return f"<table><tr>{head}</tr>{''.join(f'<tr>{row}</tr>' for row in rows)}</table>"
    if isinstance(value, list):
        return ", ".join(map(to_html, value))
    if isinstance(value, float):
        return f"{value:.6g}"
    return html.escape("" if value is None else str(value))
