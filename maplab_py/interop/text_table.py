"""Fast reading and writing of text tables of numbers whose first column is a time stamp."""

import datetime as dt
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.array_types import F64, I64, NDArray, Rows
from maplab_py.errors import MapError
from maplab_py.input_files import LARGEST, read_foreign_text
from maplab_py.interop.stamps import POSES, StampKind, header_unit, parse_stamps

_MAX_BYTES = 500_000_000
_ROWS_AT_ONCE = 1 << 15
_DEG, _G = np.pi / 180.0, 9.80665
_AXIS, _AXES = re.compile(r"(^|[^a-z])[a-z]{0,2}[wxyz]\W*(\[.*)?$"), 3
_QUANTITY = re.compile(r"(^|[_. ])[apqtvwgo]?[wxyz]$")
_UNITS_IN_NAMES = {
    **dict.fromkeys(("rad_s", "rad_per_s", "radps"), "rad/s"),
    **dict.fromkeys(("deg_s", "deg_per_s", "degps", "dps"), "deg/s"),
    **dict.fromkeys(("m_s2", "m_s_2", "m_per_s2", "mps2", "ms2"), "m/s2"),
    **dict.fromkeys(("m_s", "m_per_s", "mps"), "m/s"),
    **{unit: unit for unit in ("g", "mg", "mm", "cm", "km", "ft", "m", "deg", "rad")},
}
_UNIT_IN_NAME = re.compile(rf"(.*?[^_ ])[_ ]({'|'.join(_UNITS_IN_NAMES)})")
_MINUS = "\N{MINUS SIGN}"
_ID = re.compile(r"(^|[-_. ])id$")
_SECONDS, _NANOSECONDS = re.compile(r"(.*\.)?secs?"), re.compile(r"(.*\.)?(nano|n)secs?")
_TIME_NAME = re.compile(r"time|stamp|^t$|^t_|sec|^ns$|^utc$")
_DATE = re.compile(
    r"^(?P<before>[^\d]{0,2})(?P<day>\d{4}([-/])\d\d\3\d\d)[T\s]\s*(?P<clock>\d\d:\d\d:\d\d)(?P<part>[.]\d*)?"
    r"(?:Z|\s?UTC|[+-]00:?00)?(?=[\s,;\"]|$)"
)
"""A date and time of UTC at the beginning of a row, as ISO 8601 and RTKLIB write it."""
_GPS_TIME = re.compile(r"^gpst$|\bgps[_ ]?time$")
_UNITS = {
    "number": ("1 -",),
    "length": ("m meter meters metre metres", "cm", "mm", "km", "ft"),
    "angle": ("rad radian radians", "deg degree degrees °"),
    "velocity": ("m/s ms-1", "cm/s", "mm/s", "km/h kmh"),
    "rate": ("rad/s rads-1 1/s s-1", "deg/s degs-1 dps °/s"),
    "acceleration": ("m/s2 ms-2 m/s/s m/s²", "cm/s2", "g", "mg"),
}
_SIZES = {
    "cm": 1e-2, "mm": 1e-3, "km": 1e3, "ft": 0.3048, "deg": _DEG, "cm/s": 1e-2, "mm/s": 1e-3, "km/h": 1 / 3.6,
    "deg/s": _DEG, "cm/s2": 1e-2, "g": _G, "mg": 1e-3 * _G,
}  # fmt: skip
UNITS_OF = {
    quantity: {word: _SIZES.get(unit.split()[0], 1.0) for unit in units for word in unit.split()}
    for quantity, units in _UNITS.items()
}
"""Units of each quantity, as they stand in the brackets of a header without blanks and signs of powers."""


class TextTable(Rows):
    """Rows of a text file whose first column is a time stamp."""

    source: str
    header: tuple[str, ...]  # column names, units removed; empty when the file names none
    times_ns: I64  # (N,)
    values: F64  # (N, columns - 1)
    line_numbers: I64  # (N,) line of each row in the file, from 1
    unit: str  # of the time stamps as written: s, ms, us or ns
    has_commas: bool
    note: str = ""  # one line on the unit, where it was concluded against header or custom
    units: tuple[str, ...] = ()  # of the columns in `header`, "" where it tells none

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns of values; () where the header does not name each."""
        return self.header[1:] if len(self.header) == self.values.shape[1] + 1 else ()

    def places(self, meaning: Callable[[str], str]) -> dict[str, int]:
        """Return the place among the values of each quantity that a name means; "" means none.

        Raises:
            MapError: Two columns mean the same.
        """
        places: dict[str, int] = {}
        for place, name in enumerate(self.names):
            quantity = meaning(name)
            if quantity and quantity in places:
                raise MapError(
                    f"{self.source}: the columns '{self.names[places[quantity]]}' and '{name}' mean the same:"
                    " rename one of them"
                )
            if quantity:
                places[quantity] = place
        return places

    def columns(self, places: Sequence[int], quantity: str) -> F64:
        """Return columns of values (N, k) in SI units.

        Args:
            places: Among the values.
            quantity: A key of `UNITS_OF`, whose units are converted.

        Raises:
            MapError: The header gives a column another unit.
        """
        units, known = self.units[1:] if self.names else (), UNITS_OF[quantity]
        factors = np.ones(len(places))
        for k, unit in enumerate(units[place] for place in places if units):
            short = re.sub(r"[\s^*·]", "", unit.lower())
            factor = known.get(short, known.get(unit.lower().split(" ")[0] if " " in unit else ""))
            if short and factor is None:
                raise MapError(
                    f"{self.source}: the column '{self.names[places[k]]}' is in [{unit}], which is not known "
                    f"as a unit of {quantity}: wants one of {', '.join(known)}"
                )
            factors[k] = 1.0 if factor is None else factor
        return np.asarray(self.values[:, places] * factors)


def read_text_table(path: Path, kind: StampKind = POSES, *, unit: str = "") -> TextTable:
    """Read a table separated by commas or white space, with `#` comments and an optional header.

    The names of the columns may stand in any line that has as many words as the rows.

    Args:
        kind: Kind of its rows, which bounds the distances between their stamps.
        unit: Unit of the stamps, from --time_unit; empty = concluded.

    Raises:
        MapError: The file cannot be read, is empty, the unit of the stamps is open, or a line is not a
            row of numbers like the first one; names file and line.
    """
    text = read_foreign_text(path, _MAX_BYTES)
    return parse_text_table(text, str(path), kind, unit=unit)


def parse_text_table(
    text: str,
    source: str,
    kind: StampKind = POSES,
    *,
    unit: str = "",
    allow_nan: bool = False,
) -> TextTable:
    """Parse the text of a table; `source` is its name in error messages, see `read_text_table`.

    With `allow_nan` empty cells, infinities and NaN become NaN; else they are refused.
    """
    if '"' in text:
        text = text.replace('"', "")  # cells of tables have no commas of their own
    text = text.replace(_MINUS, "-")
    lines, numbers, others, has_dates = _data_lines(text)
    if not lines:
        raise MapError(
            f"{source}: there are no rows that begin with a time stamp: wants a number, or a date as "
            "2024-05-06T07:08:09.5"
        )
    if _has_decimal_commas(lines[0]):
        lines = [line.replace(",", ".") for line in lines]
    if ";" in lines[0]:
        lines, others = ([line.replace(";", ",") for line in part] for part in (lines, others))
    has_commas = "," in lines[0]
    header, units, time_name, rows = _named_cells(others, lines, source)
    if has_dates:
        unit, time_name = "s", ""
        if header and _GPS_TIME.search(header[0]):
            raise MapError(
                f"{source}: has dates of GPS time, which leap seconds part from UTC: write UTC, as RTKLIB's "
                "time format does"
            )
    if len(header) > 1 and _SECONDS.fullmatch(header[0]) and _NANOSECONDS.fullmatch(header[1]):
        header, time_name = ("time", *header[2:]), "time [s]"  # the stamp of ROS in two columns
        units = units[1:]
        rows = [[f"{row[0]}.{row[1]:0>9}", *row[2:]] if len(row) > 1 else row for row in rows]
    widths = np.array([len(row) for row in rows])
    wrong = np.flatnonzero(widths != widths[0])
    if len(wrong):
        row = int(wrong[0])
        raise MapError(
            f"{source}:{numbers[row]}: {widths[row]} columns, the first row has {widths[0]}: correct or "
            "remove the row"
        )
    kept = _numeric(header, rows, f"{source}:{numbers[0]}")
    if len(kept) < len(rows[0]):
        header, units = (tuple(part[k] for k in kept) for part in (header, units))
        rows = [[row[k] for k in kept] for row in rows]
    if len(kept) < 2:
        raise MapError(f"{source}:{numbers[0]}: a time stamp and values are expected")
    stamps = parse_stamps(
        [row[0] for row in rows],
        kind,
        source,
        numbers,
        unit=unit,
        header=time_name,
        custom="ns" if has_commas else "s",
    )
    cells = [row[1:] for row in rows]
    if allow_nan:
        cells = [[cell or "nan" for cell in row] for row in cells]
    values = _parse_values(cells, source, numbers, allow_nan)
    return TextTable(
        source,
        header,
        stamps.times_ns,
        values,
        np.array(numbers),
        stamps.unit,
        has_commas,
        stamps.note,
        units,
    )


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


def _data_lines(text: str) -> tuple[list[str], list[int], list[str], bool]:
    """Return the rows, their line numbers, the comments and headers, and whether stamps were dates."""
    lines: list[str] = []
    numbers: list[int] = []
    others: list[str] = []
    has_dates = False
    for number, raw in enumerate(text.splitlines(), start=1):
        line = raw.strip()
        if not line:
            continue
        if (has_dates or not lines) and (date := _DATE.match(line)) is not None:
            has_dates, line = True, date["before"] + _seconds(date) + line[date.end() :]
        if line.startswith(("#", "%")) or (
            not lines and not is_number(_split(line.replace(";", ","))[0])
        ):
            others.append(line)
            continue
        lines.append(line)
        numbers.append(number)
    return lines, numbers, others, has_dates


def _seconds(date: re.Match[str]) -> str:
    """Return the seconds since 1970 of a date, with its digits; the date itself if it is none."""
    try:
        day = dt.datetime.fromisoformat(f"{date['day'].replace('/', '-')}T{date['clock']}+00:00")
    except ValueError:
        return date[0]
    return f"{int(day.timestamp())}{date['part'] or ''}"


def _named_cells(
    others: list[str], lines: list[str], source: str
) -> tuple[tuple[str, ...], tuple[str, ...], str, list[list[str]]]:
    """Return names and units of the columns, what tells the unit of the stamps, and the cells of the rows.

    The names are in the line that has as many as the rows have cells, wherever it stands: of several the
    last that begins with a time stamp and names the most axes, as prose does not.

    Raises:
        MapError: Two lines name axes, and differently.
    """
    named = [_words(line) for line in others]
    for cells in [_cells, _split] if "," in lines[0] else [_split]:
        width = len(cells(lines[0]))
        fitting = [words for words in named if len(words) == width]
        if fitting:
            break
    timed = [words for words in fitting if is_time_name(words[0].lower())]
    chosen = max(reversed(timed or fitting or named or [[]]), key=_axes)
    if any(_axes(words) >= _AXES and words != chosen for words in timed):
        raise MapError(
            f"{source}: two lines name the columns, and differently ({' '.join(chosen)}): keep one of them"
        )
    # as in "# time stamps in microseconds"
    about = [line for line in others if re.search(r"time|stamp", line.lower())]
    telling = [name for name in (*(words[0] for words in timed), *about) if header_unit(name)]
    named_units = [_name_and_unit(word) for word in chosen]
    header, units = (tuple(pair[k] for pair in named_units) for k in (0, 1))
    if header and is_time_name(chosen[0].lower()) and not is_time_name(header[0]):
        header = ("timestamp", *header[1:])  # as in "frame_id (timestamp ns)"
    rows = [cells(line) for line in lines]
    is_table = "," in lines[0] or _axes(chosen) >= _AXES  # else it may be prose
    place = _time_place(header) if fitting and not timed and is_table else 0
    if place:  # the stamp comes first
        about = [chosen[place], *about]
        telling = [name for name in about if header_unit(name)]
        rows = [
            [row[place], *row[:place], *row[place + 1 :]] if len(row) > place else row
            for row in rows
        ]
        header = (header[place], *header[:place], *header[place + 1 :])
        units = (units[place], *units[:place], *units[place + 1 :])
    return header, units, telling[0] if telling else "", rows


def _has_decimal_commas(line: str) -> bool:
    """Return whether commas are those of decimals: semicolons or blanks separate the cells."""
    if ";" in line:
        return "," in line
    words = line.split()
    return (
        len(words) > 1
        and "," in line
        and "." not in line
        and all(re.fullmatch(r"[^,]*|[^,]*\d,\d[^,]*", word) for word in words)
    )


def _name_and_unit(word: str) -> tuple[str, str]:
    """Return name and unit of a column, as in "x [m]", "gyro_x_deg_s", "/imu/angular_velocity/x"."""
    unit = "".join(re.findall(r"[\[(](.*?)[\])]", word)[:1]).strip()
    name = re.sub(r"[\[(].*?[\])]", "", word).strip(" \t\"'").lower()
    if name.startswith("/"):
        name = name[1:].replace("/", ".")
    if not unit and (match := _UNIT_IN_NAME.fullmatch(name)) is not None:
        name, unit = match[1], _UNITS_IN_NAMES[match[2]]
    return name, unit


def _axes(words: list[str]) -> int:
    """Return how many words are names of axes, as in tx, q_w, position.x."""
    return sum(_AXIS.search(word.strip().lower()) is not None for word in words)


def _time_place(header: tuple[str, ...]) -> int:
    """Return the only column whose name says that it has time stamps, 0 if none or several do."""
    places = [place for place, name in enumerate(header) if re.search(r"time|stamp", name)]
    return places[0] if len(places) == 1 else 0


def _numeric(header: tuple[str, ...], rows: list[list[str]], where: str) -> list[int]:
    """Return the columns without those that names and first cells say to be text.

    Raises:
        MapError: There is text, and not each column has a name.
    """
    if len(header) != len(rows[0]):
        texts = [cell for cell in rows[0] if cell and not is_number(cell)]
        if texts:
            raise MapError(
                f"{where}: '{texts[0]}' is no number: a column of text is left out where a header names each "
                f"of the {len(rows[0])} columns"
            )
        return list(range(len(rows[0])))
    first = [next((row[k] for row in rows if row[k]), "") for k in range(len(header))]
    named = enumerate(zip(header, first, strict=True))
    return [
        k
        for k, (name, cell) in named
        if k == 0 or _QUANTITY.search(name) or (is_number(cell) and not _ID.search(name))
    ]


def is_time_name(name: str) -> bool:
    """Return whether a column of this name has time stamps."""
    return _TIME_NAME.search(name) is not None


def _split(line: str) -> list[str]:
    return line.replace(",", " ").split() or [""]


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.split(",")]


def is_number(cell: str) -> bool:
    """Return whether a cell is a number, also an infinite one or NaN."""
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _words(line: str) -> list[str]:
    names = re.sub(r"\s+(?=[\[(])", "", line.lstrip("#% "))
    return names.split(",") if "," in names else names.split()


def _parse_values(rows: list[list[str]], source: str, numbers: list[int], allow_nan: bool) -> F64:
    width = len(rows[0])
    text = " ".join([" ".join(row) for row in rows])
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)
            values = np.fromstring(text, dtype=np.float64, sep=" ")
    except (ValueError, DeprecationWarning):
        values = np.zeros(0)
    if values.size == len(rows) * width:
        is_usable = np.abs(values) <= LARGEST
        if allow_nan:
            values[~is_usable] = np.nan
        if allow_nan or np.all(is_usable):
            return values.reshape(len(rows), width)
    for number, row in zip(numbers, rows, strict=True):
        for token in row:
            try:
                value = float(token)
            except ValueError:
                value = np.nan
            if not abs(value) <= LARGEST and not (allow_nan and is_number(token)):
                reason = (
                    f"is beyond {LARGEST:g}" if np.isfinite(value) else "is not a finite number"
                )
                raise MapError(f"{source}:{number}: '{token}' {reason}: correct or remove the row")
    values = np.array(rows, dtype=np.float64)
    values[~(np.abs(values) <= LARGEST)] = np.nan  # allowed
    return values
