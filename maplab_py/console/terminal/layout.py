"""Layout of reports: paragraphs, pairs of name and value, tables."""

import dataclasses
import math
import re
from collections.abc import Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.report import Report

_TRANSFORMATION = re.compile(r"(?<![A-Za-z])([TRpq](?:_[A-Z]+)+)(?![A-Za-z])")
_UNIT_SUFFIXES = {
    "_m": "m",
    "_px": "px",
    "_deg": "deg",
    "_rad": "rad",
    "_s": "s",
    "_seconds": "s",
    "_ms": "ms",
    "_mb": "MB",
    "_gb": "GB",
    "_megabytes": "MB",
    "_percent": "%",
    "_mps": "m/s",
    "_mps2": "m/s^2",
    "_radps": "rad/s",
    "_degps": "deg/s",
    "_hz": "Hz",
    "_ns": "ns",
}
_WHOLE_NAMES = {"seconds": ("time", "s"), "megabytes": ("size", "MB")}
"""Names of fields that are only a unit, as a quantity and its unit."""
_WORDS = {
    "imu": "IMU",
    "gyro": "gyroscope",
    "accel": "accelerometer",
    "rms": "RMS",
    "rmse": "RMSE",
    "ape": "APE",
    "rpe": "RPE",
    "ate": "ATE",
    "sim3": "Sim(3)",
    "max": "largest",
    "min": "smallest",
    "lidar": "LiDAR",
    "freedom": "degree of freedom",
    "ransac": "RANSAC",
    "csv": "CSV",
    "json": "JSON",
    "url": "URL",
    "localized": "localised",
    "optimizations": "optimisations",
    "localization": "localisation",
}
"""Words of field names as they are shown."""


@dataclasses.dataclass(frozen=True)
class Paragraph:
    """Lines of text; verbatim ones are not folded."""

    text: str
    is_verbatim: bool = False


@dataclasses.dataclass(frozen=True)
class Pairs:
    """Names with their values, one per line, under an optional title."""

    rows: list[tuple[str, str]]
    title: str = ""


@dataclasses.dataclass(frozen=True)
class Table:
    """Rows under column heads, with an optional title.

    Entries are rows whose first cell is a term and whose last one explains it; a narrow terminal
    shows the explanation under the term.
    """

    title: str
    heads: list[str]
    rows: list[list[str]]
    is_number: list[bool]  # columns that are aligned to the right
    are_entries: bool = False


Block = Paragraph | Pairs | Table


def blocks_of(report: Any, title: str = "", error: str = "") -> list[Block]:
    """Lay out a report: its single values first, then its lists and nested reports.

    Args:
        report: The report, or a record of one.
        title: Title of a nested report.
        error: Failure of the report around it, which is printed anyway.

    The metadata of a field can hold its `title` (empty: no title) and its `unit`; `is_prose` marks
    a text that stands without a title, `are_entries` a list that explains terms, `deviation` the
    standard deviation of a column's numbers, or the field that holds it.
    """
    failure = error or (report.failure if isinstance(report, Report) else "")
    for _ in range(2):  # what a report displays can be a sentence
        if isinstance(report, Report):
            text = report.as_text()
            if text is not None:
                return [Paragraph(text, report.is_verbatim)] if text else []
            report = report.display()
    pairs: list[tuple[str, str]] = []
    following: list[Block] = []
    alike = _records_of_equal_kind(report)
    for field in dataclasses.fields(report):
        value = getattr(report, field.name)
        if field.name in alike:
            following += _columns_of_records(alike.pop(field.name))
            continue
        if _is_record(value) and getattr(value, "is_empty", False):
            continue
        head = heading(field)
        value = _without_failure(value, failure)
        if _is_absent(value):
            continue
        if field.metadata.get("is_prose"):
            following.append(Paragraph(str(value)))
        elif _is_record(value):
            following += blocks_of(value, head, failure)
        elif _is_records(value) and any(_has_records(record) for record in value):
            following += [block for record in value for block in blocks_of(record)]
        elif _is_records(value):
            following += _tables(head, value, are_entries=field.metadata.get("are_entries", False))
        elif isinstance(value, Mapping) and all(map(_is_records, value.values())):
            following += [
                table for key, records in value.items() for table in _tables(str(key), records)
            ]
        elif isinstance(value, Mapping) and any(map(_is_record, value.values())):
            following += [block for key, item in value.items() for block in blocks_of(item, key)]
        elif isinstance(value, Mapping):
            rows = [(str(key), format_cell(item)) for key, item in value.items()]
            following.append(Pairs(rows, head))
        elif _is_lines(value):
            following.append(Paragraph("\n".join([f"{head}:", *(f"  {v}" for v in value)])))
        else:
            pairs.append((head, format_cell(value)))
    if pairs:
        return [Pairs(pairs, title), *following]
    return _under(title, following)


def _records_of_equal_kind(report: Any) -> dict[str, list[tuple[str, Any]]]:
    """Return the headings and records of the fields whose records have one kind and single values.

    The key is the name of the field; only the first field of a kind has records. Records that say
    that they are empty (`is_empty`) are left out.
    """
    kinds: dict[type, list[str]] = {}
    for field in dataclasses.fields(report):
        value = getattr(report, field.name)
        if _is_record(value) and not isinstance(value, Report) and _has_single_values(value):
            kinds.setdefault(type(value), []).append(field.name)
    fields = {field.name: field for field in dataclasses.fields(report)}
    groups: dict[str, list[tuple[str, Any]]] = {}
    for names in (names for names in kinds.values() if len(names) > 1):
        records = [(heading(fields[name]), getattr(report, name)) for name in names]
        groups |= {name: [] for name in names}
        groups[names[0]] = [
            (head, record) for head, record in records if not getattr(record, "is_empty", False)
        ]
    return groups


def _has_single_values(record: Any) -> bool:
    values = [getattr(record, field.name) for field in dataclasses.fields(record)]
    return all(value is None or isinstance(value, _SINGLE_TYPES) for value in values)


def _columns_of_records(records: list[tuple[str, Any]]) -> list[Table]:
    """Return a table with a column per record and a row per field; none without records."""
    if not records:
        return []
    fields = dataclasses.fields(records[0][1])
    columns = [
        format_column([getattr(record, field.name) for field in fields]) for _, record in records
    ]
    rows = [
        [heading(field), *cells]
        for field, *cells in zip(fields, *columns, strict=True)
        if not all(_is_absent(getattr(record, field.name)) for _, record in records)
    ]
    heads = ["", *(head for head, _ in records)]
    return [Table("", heads, rows, [False, *(True for _ in records)])]


def _under(title: str, blocks: list[Block]) -> list[Block]:
    """Give the title of a record without single values to its first block if that has none."""
    if title and blocks and not isinstance(blocks[0], Paragraph) and not blocks[0].title:
        return [dataclasses.replace(blocks[0], title=title), *blocks[1:]]
    return blocks


def heading(field: dataclasses.Field[Any]) -> str:
    """Return a readable name of a field with its unit in brackets."""
    if "title" in field.metadata:
        name = str(field.metadata["title"])
        unit = field.metadata.get("unit", "")
    else:
        name, unit = field.name, field.metadata.get("unit", "")
        name, unit = _WHOLE_NAMES.get(name, (name, unit))
        for suffix, meaning in _UNIT_SUFFIXES.items():
            if name.endswith(suffix):
                unit = unit or meaning
                if unit == meaning:
                    name = name.removesuffix(suffix)
                break
        if name.startswith("seconds_"):
            rest, unit = name.removeprefix("seconds_"), "s"
            name = f"time_{rest}" if rest.startswith("per_") else f"{rest}_time"
        name = _with_spaces(name)
    return f"{name} [{unit}]" if unit else name


def _with_spaces(name: str) -> str:
    """Replace underscores by spaces except in names of transformations such as T_G_M."""
    parts = _TRANSFORMATION.split(name)
    parts[::2] = [part.replace("_", " ") for part in parts[::2]]
    words = "".join(parts).split()
    if words[:1] == ["num"]:
        words = words[1:]
    return " ".join(_WORDS.get(word, word) for word in words)


def _is_record(value: Any) -> bool:
    return dataclasses.is_dataclass(value) and not isinstance(value, type)


def _is_records(value: Any) -> bool:
    return isinstance(value, (list, tuple)) and len(value) > 0 and all(map(_is_record, value))


def _has_records(record: Any) -> bool:
    return any(_is_records(getattr(record, field.name)) for field in dataclasses.fields(record))


def _is_lines(value: Any) -> bool:
    """Tell whether a value is a list of sentences, which are printed one per line."""
    return (
        isinstance(value, (list, tuple))
        and len(value) > 0
        and all(isinstance(item, str) for item in value)
        and sum(len(item) for item in value) > 80
        and max(len(item) for item in value) > _LONGEST_WORD
    )


def _without_failure(value: Any, failure: str) -> Any:
    """Return a text or a list of sentences without what the error line says anyway."""
    if not failure:
        return value
    if isinstance(value, str):
        return "" if value and value in failure else value
    if isinstance(value, (list, tuple)) and all(isinstance(item, str) for item in value):
        return type(value)(item for item in value if item not in failure)
    return value


def _is_absent(value: Any) -> bool:
    """Tell whether a value is empty: no value, no text, no rows."""
    return value is None or (isinstance(value, (str, list, tuple, Mapping)) and len(value) == 0)


def _tables(title: str, records: Sequence[Any], *, are_entries: bool = False) -> list[Table]:
    """Return a table of the fields that any record has a value for; none if there is no such field."""
    fields = dataclasses.fields(records[0])
    columns = [[getattr(record, field.name) for record in records] for field in fields]
    kept = [i for i, column in enumerate(columns) if not all(map(_is_absent, column))]
    if not kept:
        return []
    cells = [
        _format_certain(columns[i], records, fields[i].metadata["deviation"])
        if "deviation" in fields[i].metadata
        else format_column([_flat(value) for value in columns[i]])
        for i in kept
    ]
    rows = [list(row) for row in zip(*cells, strict=True)]
    numeric = [all(isinstance(v, _NUMBER_TYPES) for v in columns[i]) for i in kept]
    return [Table(title, [heading(fields[i]) for i in kept], rows, numeric, are_entries)]


_NUMBER_TYPES = (int, float, np.integer, np.floating, type(None))
_LONGEST_WORD = 12
"""Lists of texts that are no longer are printed as words, separated by commas."""
_SINGLE_TYPES = (str, int, float, np.integer, np.floating)


def _flat(value: Any) -> Any:
    """Return a value of a cell; a record in a cell becomes text."""
    if not _is_record(value):
        return value
    return ", ".join(
        f"{heading(f)} {format_cell(getattr(value, f.name))}" for f in dataclasses.fields(value)
    )


_SIGNIFICANT_DIGITS = 4
_LEAST_SIGNIFICANT_DIGITS = 3
_MORE_DECIMALS = 2
_MAX_DECIMALS = 6
_MAX_CERTAIN_DECIMALS = 9
_FIXED_POINT_RANGE = (1e-4, 1e9)
_ROUNDING_NOISE = 1e-12
"""Smaller numbers are shown as zeros."""


def format_cell(value: Any) -> str:
    """Format one value; numbers have four to six significant digits."""
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


def format_column(values: Sequence[Any]) -> list[str]:
    """Format the cells of a column; its numbers with fractions have the same number of decimals.

    The largest number has at least four significant digits, and up to two decimals more if the
    smallest needs them. Where the largest would be too long or too small all numbers have exponents.
    """
    numbers = [abs(float(v)) for v in values if isinstance(v, (float, np.floating))]
    sizes = [number for number in numbers if number > 0 and math.isfinite(number)]
    if not sizes or max(sizes) < _ROUNDING_NOISE:
        return [_format_plain(0.0 if _is_number(value) else value) for value in values]
    low, high = _FIXED_POINT_RANGE
    if not low <= max(sizes) < high:
        return [f"{value:.3e}" if _is_number(value) else _format_plain(value) for value in values]
    largest = max(_SIGNIFICANT_DIGITS - 1 - math.floor(math.log10(max(sizes))), 0)
    smallest = _LEAST_SIGNIFICANT_DIGITS - 1 - math.floor(math.log10(min(sizes)))
    decimals = min(max(largest, min(smallest, largest + _MORE_DECIMALS)), _MAX_DECIMALS)
    return [
        _format_fixed(float(value), decimals) if _is_number(value) else _format_plain(value)
        for value in values
    ]


def _format_certain(
    values: Sequence[Any], records: Sequence[Any], deviation: str | float
) -> list[str]:
    """Format numbers to the second digit of their standard deviations."""
    cells = []
    for value, record in zip(values, records, strict=True):
        sigma = getattr(record, deviation) if isinstance(deviation, str) else deviation
        if _is_number(value) and _is_number(sigma) and sigma > 0.0:
            decimals = 1 - math.floor(math.log10(sigma))
            cells.append(_format_fixed(value, min(max(decimals, 0), _MAX_CERTAIN_DECIMALS)))
        else:
            cells.append(format_cell(value))
    return cells


def _format_fixed(value: float, decimals: int) -> str:
    """Format a number with decimals; what they round to zero has no sign."""
    text = f"{value:.{decimals}f}"
    return text if float(text) else text.removeprefix("-")


def _is_number(value: Any) -> bool:
    """Tell whether a cell is a finite number with a fraction."""
    return isinstance(value, (float, np.floating)) and math.isfinite(value)


def _format_plain(value: Any) -> str:
    if isinstance(value, Path):
        return str(value)
    is_empty = isinstance(value, (str, list, tuple, Mapping)) and len(value) == 0
    return "" if is_empty else format_cell(value)


def _format_float(value: float) -> str:
    if not np.isfinite(value):
        return "-" if np.isnan(value) else str(value)
    if abs(value) < _ROUNDING_NOISE:
        value = 0.0
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
