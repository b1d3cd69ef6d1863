"""Time stamps written as text: exact nanoseconds, in a unit that is known, concluded, or asked for.

The unit is that of `--time_unit`, else of the header, else the only one that makes a file of its kind
plausible: rows as far apart as such sensors deliver them, a date of this century. Where several units
remain, or none, the file is refused.
"""

import dataclasses
import re
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.errors import MapError
from maplab_py.input_files import read_foreign_text
from maplab_py.options import option

UNITS = {"s": 9, "ms": 6, "us": 3, "ns": 0}
"""Decimal exponent of each unit in nanoseconds."""
_MAX_BYTES = 500_000_000
_NUMBER = re.compile(r"([+-]?)(\d*)(?:\.(\d*))?(?:[eE]([+-]?\d{1,3}))?")
_PLACES = 18
"""Decimal places that are kept: fractions are whole numbers of 10^-18 units."""
_INT64_DIGITS = 19
_CALENDAR_S = (946_684_800, 2_600_000_000)
"""Seconds since 1970 of dates from 2000 to 2052."""
_ANY_STEP_S = (1e-6, 1e6)
_STEPS_PER_ROUNDING = 100.0
"""Stamps in scientific notation are refused if their last digit is coarser than this part of a step."""
_WORDS = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), "s"),
    **dict.fromkeys(("ms", "msec", "millis", "millisec", "millisecond", "milliseconds"), "ms"),
    **dict.fromkeys(("us", "µs", "μs", "usec", "micros", "microsec", "microsecond"), "us"),
    **dict.fromkeys(("microseconds",), "us"),
    **dict.fromkeys(("ns", "nsec", "nsecs", "nanos", "nanosec", "nanosecond"), "ns"),
    **dict.fromkeys(("nanoseconds",), "ns"),
}


@dataclasses.dataclass(frozen=True)
class StampKind:
    """Distances between stamps [s] of one kind of file."""

    name: str  # as in "no IMU delivers that"
    typical_s: tuple[float, float]
    possible_s: tuple[float, float]


IMU = StampKind("IMU", (1e-4, 0.1), (2e-5, 1.0))
IMAGES = StampKind("camera", (2e-3, 1.0), (5e-4, 3600.0))
POSES = StampKind("trajectory", (2e-3, 2.0), (1e-4, 3600.0))
FIXES = StampKind("receiver", (0.02, 2.0), (1e-3, 3600.0))
WHEELS = StampKind("wheel sensor", (1e-3, 1.0), (1e-4, 100.0))


def time_unit_option() -> Any:
    """Return the declaration of the flag --time_unit."""
    return option(
        "",
        help="Unit of written time stamps; empty = that of the header, or the only plausible one",
        choices=("", *UNITS),
        flag="time_unit",
    )


@dataclasses.dataclass(frozen=True, eq=False)
class Stamps:
    """Times of the rows of a file."""

    times_ns: I64  # (N,)
    unit: str  # as written: s, ms, us or ns
    note: str = ""  # one line where the unit was concluded against a header or a custom


def header_unit(name: str) -> str:
    """Return the unit that a column's name tells, as in "timestamp [ns]" or "time_s"; else nothing."""
    for part in (*re.findall(r"[\[(]([^\])]*)[\])]", name), name):
        words = re.split(r"[^a-zµμ]+", part.strip().lower())
        is_of_time = part is name or re.search("time|stamp", words[0])
        unit = _WORDS.get(words[-1] if is_of_time else part.strip().lower())
        if unit:
            return unit
    return ""


def parse_stamps(
    tokens: Sequence[str],
    kind: StampKind,
    source: str,
    lines: Sequence[int] | I64 | None = None,
    *,
    unit: str = "",
    header: str = "",
    custom: str = "ns",
) -> Stamps:
    """Return the times of stamps.

    Args:
        tokens: Numbers as written.
        kind: Kind of file, which bounds the distances between rows.
        source: Name of the file, for messages.
        lines: Line of each token, from 1; None = 1, 2, ...
        unit: Unit of all stamps, from --time_unit; empty = concluded.
        header: Name of the column, which may tell the unit.
        custom: Unit that the format prescribes where nothing is written.

    Raises:
        MapError: A token is no number, a time is beyond 64 bits, digits are lost, or the unit is open.
    """
    numbers = _Numbers(tokens, source, lines)
    if unit:
        return Stamps(numbers.times_ns(unit), unit)
    named = header_unit(header)
    fitting = [name for name in UNITS if numbers.fits(name)]
    possible = [name for name in fitting if _is_within(numbers.step_s(name), kind.possible_s)]
    if named in possible or (named in fitting and _is_kept(numbers.step_s(named), kind, possible)):
        return Stamps(numbers.times_ns(named), named)
    concluded = _concluded(numbers, kind, possible, custom)
    if not concluded:
        raise MapError(numbers.open_unit(kind, named, fitting))
    times_ns = numbers.times_ns(concluded)
    if named:
        return Stamps(
            times_ns,
            concluded,
            f"{source}: time stamps are read as {concluded}: in {named}, as its header says, rows would be "
            f"{numbers.step_text(named)} apart",
        )
    is_usual = concluded in (custom, "s" if numbers.has_fractions else custom)
    return Stamps(
        times_ns, concluded, "" if is_usual else f"{source}: time stamps are read as {concluded}"
    )


def read_stamps(path: Path, kind: StampKind, *, unit: str = "") -> Stamps:
    """Read a file with one stamp per line; comments (`#`) may name the unit.

    Raises:
        MapError: The file cannot be read or is empty, or as `parse_stamps`.
    """
    text = read_foreign_text(path, _MAX_BYTES)
    rows = [(number, line.strip()) for number, line in enumerate(text.splitlines(), start=1)]
    header = next((line for _, line in rows if line.startswith(("#", "%"))), "")
    rows = [(number, line) for number, line in rows if line and line[0] not in "#%"]
    if not rows:
        raise MapError(f"{path}: there are no time stamps in the file: write or copy it again")
    lines, tokens = zip(*rows, strict=True)
    return parse_stamps(tokens, kind, str(path), lines, unit=unit, header=header, custom="s")


class _Numbers:
    """Numbers of a column, exact: whole part and fraction apart."""

    def __init__(
        self, tokens: Sequence[str], source: str, lines: Sequence[int] | I64 | None
    ) -> None:
        self._tokens, self._source, self._lines = tokens, source, lines
        self._digits, self._magnitude = 0, 0
        joined = "".join(tokens)
        widths = [len(token) for token in tokens]
        is_whole = joined.isascii() and joined.isdecimal() and min(widths) > 0
        if is_whole and max(widths) <= _INT64_DIGITS:
            unsigned = np.array(tokens, dtype=np.str_).astype(np.uint64)
            if unsigned.max() >= 1 << 63:
                row = int(np.argmax(unsigned))
                raise MapError(
                    f"{self._place(row)}: the time stamp '{tokens[row]}' is beyond 64 bits"
                )
            self._whole: I64 = unsigned.astype(np.int64)
            self._fraction: I64 = np.zeros(len(tokens), dtype=np.int64)
        else:
            self._parse_slowly()
        values: F64 = (self._whole - self._whole[0]).astype(
            np.float64
        ) + self._fraction * 10.0**-_PLACES
        steps = np.abs(np.diff(values))
        steps = steps[steps > 0.0]
        self._step = float(np.median(steps)) if len(steps) else 0.0
        self._usual = float(np.median(self._whole))
        self._largest = int(np.abs(self._whole).max())
        self.has_fractions = bool(np.any(self._fraction))

    def _parse_slowly(self) -> None:
        """Parse decimals and numbers in scientific notation."""
        self._whole = np.empty(len(self._tokens), dtype=np.int64)
        self._fraction = np.empty(len(self._tokens), dtype=np.int64)
        for row, token in enumerate(self._tokens):
            match = _NUMBER.fullmatch(token)
            if match is None or not (match[2] or match[3]):
                raise MapError(f"{self._place(row)}: '{token}' is not a time stamp: wants a number")
            sign, whole, fraction, exponent = match[1], match[2], match[3] or "", match[4]
            if exponent:
                self._digits = max(self._digits, len((whole + fraction).lstrip("0")))
                value = Decimal(token)
                self._magnitude = max(self._magnitude, value.adjusted() if value else 0)
                whole, _, fraction = f"{abs(value):f}".partition(".")
            if len(whole) > _INT64_DIGITS or int(whole or 0) >= 1 << 63:
                raise MapError(f"{self._place(row)}: the time stamp '{token}' is beyond 64 bits")
            signed = -1 if sign == "-" else 1
            self._whole[row] = signed * int(whole or 0)
            self._fraction[row] = signed * int(fraction[:_PLACES].ljust(_PLACES, "0"))

    def times_ns(self, unit: str) -> I64:
        """Return the times in a unit, rounded to nanoseconds."""
        if not self.fits(unit):
            row = int(np.argmax(np.abs(self._whole)))
            raise MapError(
                f"{self._place(row)}: the time stamp '{self._tokens[row]}' is beyond 64 bits in {unit}: give "
                f"another --time_unit"
            )
        exponent = UNITS[unit]
        lost = 10.0 ** (self._magnitude - self._digits + 1) if self._digits else 0.0
        if lost * 10.0**exponent >= 1.0 and (
            not self._step or lost * _STEPS_PER_ROUNDING > self._step
        ):
            raise MapError(
                f"{self._place(0)}: '{self._tokens[0]}' is rounded: the last digit of the largest stamp is "
                f"{_time_text(lost * 10.0 ** (exponent - 9))} (in {unit}): write whole numbers or decimals "
                "with all digits (if that is another unit: --time_unit=s|ms|us|ns)"
            )
        divisor = 10 ** (_PLACES - exponent)
        rest, over = np.divmod(self._fraction, divisor)
        rest += (over > divisor // 2) | ((over == divisor // 2) & (rest % 2 == 1))
        times: I64 = self._whole * 10**exponent + rest
        return times

    def fits(self, unit: str) -> bool:
        """Return whether all times have 64 bits in a unit."""
        return bool((self._largest + 1) * 10 ** UNITS[unit] < 1 << 63)

    def step_s(self, unit: str) -> float:
        """Return the median distance of neighbouring rows [s]; 0 for one row."""
        return self._step * 10.0 ** (UNITS[unit] - 9)

    def step_text(self, unit: str) -> str:
        """Return the median distance with its unit."""
        return _time_text(self.step_s(unit))

    def is_calendar_time(self, unit: str) -> bool:
        """Return whether the times are dates of this century."""
        return _is_within(self._usual * 10.0 ** (UNITS[unit] - 9), _CALENDAR_S)

    def open_unit(self, kind: StampKind, named: str, fitting: list[str]) -> str:
        """Return the message that the unit remains open."""
        if len(self._tokens) == 1 or not self._step:
            reason = f"of one time ('{self._tokens[0]}') the unit cannot be told"
        else:
            steps = ", ".join(f"{self.step_text(name)} in {name}" for name in fitting)
            reason = f"the unit of the time stamps is open: rows are {steps} apart"
            if named:
                reason = (
                    f"in {named}, as the header says, rows are {self.step_text(named)} apart, as no "
                    f"{kind.name} delivers them ({steps})"
                )
        return (
            f"{self._place(0)}: {reason}: give --time_unit=s|ms|us|ns, or write the unit into a header, as "
            "in `# timestamp [ns]`"
        )

    def _place(self, row: int) -> str:
        line = row + 1 if self._lines is None else self._lines[row]
        return f"{self._source}:{line}"


def _is_kept(step_s: float, kind: StampKind, possible: list[str]) -> bool:
    """Return whether a header's unit holds although rows would be unusually far apart."""
    return not step_s or not possible or (kind is not IMU and _is_within(step_s, _ANY_STEP_S))


def _concluded(numbers: _Numbers, kind: StampKind, possible: list[str], custom: str) -> str:
    """Return the unit that alone is plausible; empty if it remains open."""
    custom = "s" if numbers.has_fractions else custom
    fitting = [name for name in UNITS if numbers.fits(name)]
    if len(fitting) == 1 or not numbers.step_s("s"):
        # of a single time: the format's unit, unless the date would be another
        if len(fitting) == 1:
            return fitting[0]
        dated = [name for name in fitting if numbers.is_calendar_time(name)]
        return custom if custom in fitting and (not dated or custom in dated) else ""
    typical = [name for name in possible if _is_within(numbers.step_s(name), kind.typical_s)]
    dated = [name for name in possible if numbers.is_calendar_time(name)]
    both = [name for name in typical if name in dated]
    if len(both) == 1:
        return both[0]
    if custom in typical:
        return custom
    if len(dated) == 1:
        return dated[0] if not typical else ""
    return typical[0] if len(typical) == 1 and custom not in possible else ""


def _is_within(value: float, bounds: tuple[float, float]) -> bool:
    return bounds[0] * (1.0 - 1e-6) <= value <= bounds[1] * (1.0 + 1e-6)


def _time_text(seconds: float) -> str:
    for size, name in ((1.0, "s"), (1e-3, "ms"), (1e-6, "us")):
        if seconds >= size:
            return f"{seconds / size:.4g} {name}"
    return f"{seconds * 1e9:.4g} ns"
