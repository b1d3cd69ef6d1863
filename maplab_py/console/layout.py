"""Turning reports into blocks of text: paragraphs, pairs of name and value, tables."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.report import Report

_UNIT_SUFFIXES = {
    "_m": "m",
    "_px": "px",
    "_deg": "deg",
    "_rad": "rad",
    "_s": "s",
    "_seconds": "s",
    "_ms": "ms",
    "_mb": "MB",
    "_megabytes": "MB",
    "_percent": "%",
    "_mps": "m/s",
}


@dataclasses.dataclass(frozen=True)
class Paragraph:
    """Lines of text."""

    text: str


@dataclasses.dataclass(frozen=True)
class Pairs:
    """Names with their values, one per line, under an optional title."""

    rows: list[tuple[str, str]]
    title: str = ""


@dataclasses.dataclass(frozen=True)
class Table:
    """Rows under column heads, with an optional title."""

    title: str
    heads: list[str]
    rows: list[list[str]]
    is_number: list[bool]  # columns that are aligned to the right


Block = Paragraph | Pairs | Table


def blocks_of(report: Any, title: str = "") -> list[Block]:
    """Lay out a report: its single values first, then its lists and nested reports."""
    text = report.as_text() if isinstance(report, Report) else None
    if text is not None:
        return [Paragraph(text)] if text else []
    pairs: list[tuple[str, str]] = []
    following: list[Block] = []
    for field in dataclasses.fields(report):
        value = getattr(report, field.name)
        head = heading(field)
        if _is_record(value):
            following += blocks_of(value, head)
        elif _is_records(value) and any(_has_records(record) for record in value):
            following += [block for record in value for block in blocks_of(record)]
        elif _is_records(value):
            following.append(_table(head, value))
        elif isinstance(value, Mapping) and value and all(map(_is_records, value.values())):
            following += [_table(str(key), records) for key, records in value.items()]
        elif isinstance(value, Mapping) and any(map(_is_record, value.values())):
            following += [block for key, item in value.items() for block in blocks_of(item, key)]
        elif isinstance(value, Mapping):
            rows = [(str(key), format_cell(item)) for key, item in value.items()]
            following.append(Pairs(rows, head))
        elif _is_lines(value):
            following.append(Paragraph("\n".join([f"{head}:", *(f"  {v}" for v in value)])))
        elif not _is_absent(value):
            pairs.append((head, format_cell(value)))
    return ([Pairs(pairs, title)] if pairs else []) + following


def heading(field: dataclasses.Field[Any]) -> str:
    """Return a field's name for people, with its unit in brackets."""
    if field.metadata.get("title"):
        name = str(field.metadata["title"])
        unit = field.metadata.get("unit", "")
    else:
        name, unit = field.name, field.metadata.get("unit", "")
        for suffix, meaning in _UNIT_SUFFIXES.items():
            if name.endswith(suffix):
                unit = unit or meaning
                if unit == meaning:
                    name = name.removesuffix(suffix)
                break
        name = name.replace("_", " ").strip()
    return f"{name} [{unit}]" if unit else name


def format_cell(value: Any) -> str:
    """Write one value for people: numbers with four to six significant digits."""
    if isinstance(value, (bool, np.bool_)):
        return "yes" if value else "no"
    if isinstance(value, (float, np.floating)):
        return _format_float(float(value))
    if isinstance(value, (int, np.integer)) and not isinstance(value, Enum):
        return f"{int(value)}"
    if isinstance(value, Enum):
        return value.name.lower()
    if isinstance(value, np.ndarray):
        return _format_array(value)
    if isinstance(value, (list, tuple, set, frozenset)):
        return ", ".join(format_cell(item) for item in value) or "none"
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {format_cell(item)}" for key, item in value.items()) or "none"
    return "-" if value is None else str(value)


def _format_float(value: float) -> str:
    if not np.isfinite(value):
        return "-" if np.isnan(value) else str(value)
    if value == 0 or 1e-4 <= abs(value) < 1e6:
        digits = 4 if abs(value) < 100 else 2
        return f"{value:.{digits}f}" if abs(value) >= 1e-2 or value == 0 else f"{value:.6f}"
    return f"{value:.4g}"


def _format_array(value: np.ndarray[Any, Any]) -> str:
    if value.size > 16:
        shape = " x ".join(str(n) for n in value.shape)
        return f"array of {shape}"
    if value.ndim <= 1:
        return " ".join(format_cell(item) for item in np.atleast_1d(value))
    return "; ".join(_format_array(row) for row in value)


def _is_record(value: Any) -> bool:
    return dataclasses.is_dataclass(value) and not isinstance(value, type)


def _is_records(value: Any) -> bool:
    return isinstance(value, (list, tuple)) and len(value) > 0 and all(map(_is_record, value))


def _has_records(record: Any) -> bool:
    return any(_is_records(getattr(record, field.name)) for field in dataclasses.fields(record))


def _is_lines(value: Any) -> bool:
    """Tell a list of sentences, which are set one per line."""
    return (
        isinstance(value, (list, tuple))
        and len(value) > 0
        and all(isinstance(item, str) for item in value)
        and sum(len(item) for item in value) > 80
    )


def _is_absent(value: Any) -> bool:
    """Tell what there is nothing to say about: no value, no text, no rows."""
    return value is None or (isinstance(value, (str, list, tuple, dict)) and len(value) == 0)


def _table(title: str, records: Sequence[Any]) -> Table:
    fields = dataclasses.fields(records[0])
    columns = [[getattr(record, field.name) for record in records] for field in fields]
    kept = [i for i, column in enumerate(columns) if not all(map(_is_absent, column))]
    rows = [[_cell(columns[i][row]) for i in kept] for row in range(len(records))]
    numeric = [all(isinstance(v, _NUMBER_TYPES) for v in columns[i]) for i in kept]
    return Table(title, [heading(fields[i]) for i in kept], rows, numeric)


_NUMBER_TYPES = (int, float, np.integer, np.floating, type(None))


def _cell(value: Any) -> str:
    if isinstance(value, Path):
        return str(value)
    if _is_record(value):
        return ", ".join(
            f"{heading(f)} {format_cell(getattr(value, f.name))}" for f in dataclasses.fields(value)
        )
    return "" if _is_absent(value) and value is not None else format_cell(value)
