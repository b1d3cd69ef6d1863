"""Fast reading and writing of text tables of numbers.

Time stamps are parsed from their digits without conversion to float: 19-digit nanoseconds and
"1403715529.112143517" seconds are both exact.
"""

from __future__ import annotations

import dataclasses
import re
import warnings
from collections.abc import Iterator, Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maplab_py.array_types import F64, I64
from maplab_py.errors import MapError
from maplab_py.input_files import read_text

_MAX_BYTES = 500_000_000
_SPLIT = "split it into parts"
_ROWS_AT_ONCE = 1 << 15
_NANOSECONDS_FROM = 10**14
"""Integers above this are nanoseconds; as seconds they would be three million years."""


@dataclasses.dataclass(frozen=True, eq=False)
class TextTable:
    """Rows of a text file whose first column is a time stamp."""

    source: str
    header: tuple[str, ...]  # column names, units removed; empty when the file names none
    times_ns: I64  # (N,)
    values: F64  # (N, columns - 1)
    line_numbers: I64  # (N,) line of each row in the file, from 1
    is_nanoseconds: bool  # the file's time stamps were whole nanoseconds
    has_commas: bool


def read_text_table(path: Path) -> TextTable:
    """Read a table separated by commas or white space, with `#` comments and an optional header.

    Raises:
        MapError: The file cannot be read, is empty, or a line is not a row of numbers like the
            first one; names file and line.
    """
    try:
        text = read_text(path, _MAX_BYTES, remedy=_SPLIT, error=MapError, encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise MapError(f"cannot read {path}: {reason}") from error
    return parse_text_table(text, str(path))


def parse_text_table(text: str, source: str) -> TextTable:
    """Parse the text of a table; `source` is its name in error messages."""
    lines, numbers, header = _data_lines(text)
    if not lines:
        raise MapError(f"{source}: there are no rows in the file: write or copy it again")
    has_commas = "," in lines[0]
    rows = [line.replace(",", " ").split() for line in lines]
    widths = np.array([len(row) for row in rows])
    wrong = np.flatnonzero(widths != widths[0])
    if len(wrong):
        row = int(wrong[0])
        raise MapError(
            f"{source}:{numbers[row]}: {widths[row]} columns, the first row has {widths[0]}: correct or "
            "remove the row"
        )
    if widths[0] < 2:
        raise MapError(f"{source}:{numbers[0]}: a time stamp and values are expected")
    times, is_nanoseconds = _parse_times([row[0] for row in rows], source, numbers)
    values = _parse_values([row[1:] for row in rows], source, numbers)
    return TextTable(source, header, times, values, np.array(numbers), is_nanoseconds, has_commas)


def format_rows(row_format: str, columns: Sequence[NDArray[Any] | list[Any]]) -> Iterator[str]:
    """Yield text of rows, many at a time.

    Args:
        row_format: %-format of one row without line end, one place per column entry.
        columns: Arrays (N,) or (N, k) or lists of N values, in the order of the places.
    """
    flat: list[Any] = []
    for column in columns:
        is_wide = isinstance(column, np.ndarray) and column.ndim == 2
        flat.extend(column.T if is_wide else [column])  # type: ignore[union-attr]
    count = len(flat[0]) if flat else 0
    line = row_format + "\n"
    for begin in range(0, count, _ROWS_AT_ONCE):
        parts = [part[begin : begin + _ROWS_AT_ONCE] for part in flat]
        lists = [part.tolist() if isinstance(part, np.ndarray) else part for part in parts]
        values = [value for row in zip(*lists, strict=True) for value in row]
        yield (line * len(lists[0])) % tuple(values)


def seconds_text(times_ns: I64) -> tuple[I64, I64]:
    """Return whole seconds and nanoseconds, for the format `%d.%09d` of times that are >= 0."""
    seconds, rest = np.divmod(times_ns, 1_000_000_000)
    return seconds, rest


def _data_lines(text: str) -> tuple[list[str], list[int], tuple[str, ...]]:
    """Return the rows, their line numbers, and the column names above them."""
    lines: list[str] = []
    numbers: list[int] = []
    header: tuple[str, ...] = ()
    for number, raw in enumerate(text.splitlines(), start=1):
        line = raw.strip()
        if not line:
            continue
        is_comment = line.startswith(("#", "%"))
        if is_comment or (not lines and not header and not _starts_with_number(line)):
            header = _column_names(line) if not lines else header
            continue
        lines.append(line)
        numbers.append(number)
    return lines, numbers, header


def _starts_with_number(line: str) -> bool:
    first = line.replace(",", " ").split()[0]
    try:
        float(first)
    except ValueError:
        return False
    return True


def _column_names(line: str) -> tuple[str, ...]:
    names = line.lstrip("#% ")
    cut = names.split(",") if "," in names else names.split()
    return tuple(re.sub(r"[\[(].*?[\])]", "", name).strip().lower() for name in cut)


def _parse_times(tokens: list[str], source: str, numbers: list[int]) -> tuple[I64, bool]:
    try:
        whole = np.array(tokens, dtype=np.str_).astype(np.int64)
    except (ValueError, OverflowError):
        return _decimal_times(tokens, source, numbers), False
    if np.all(np.abs(whole) < _NANOSECONDS_FROM):
        return _decimal_times(tokens, source, numbers), False
    return whole, True


def _decimal_times(tokens: list[str], source: str, numbers: list[int]) -> I64:
    """Parse seconds to nanoseconds, digit by digit."""
    times = np.empty(len(tokens), dtype=np.int64)
    for row, token in enumerate(tokens):
        try:
            times[row] = int((Decimal(token) * 1_000_000_000).to_integral_value())
        except (InvalidOperation, ValueError, OverflowError) as error:
            raise MapError(f"{source}:{numbers[row]}: '{token}' is not a time stamp") from error
    return times


def _parse_values(rows: list[list[str]], source: str, numbers: list[int]) -> F64:
    width = len(rows[0])
    text = " ".join([" ".join(row) for row in rows])
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)
            values = np.fromstring(text, dtype=np.float64, sep=" ")
    except (ValueError, DeprecationWarning):
        values = np.zeros(0)
    if values.size == len(rows) * width and np.all(np.isfinite(values)):
        return values.reshape(len(rows), width)
    for number, row in zip(numbers, rows, strict=True):
        for token in row:
            try:
                is_finite = bool(np.isfinite(float(token)))
            except ValueError:
                is_finite = False
            if not is_finite:
                raise MapError(
                    f"{source}:{number}: '{token}' is not a finite number: correct or remove the row"
                )
    return np.array(rows, dtype=np.float64)
