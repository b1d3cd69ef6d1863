"""Positions of satellite receivers: CSV with time, latitude, longitude and altitude, and NMEA 0183.

NMEA: sentences GGA of any talker have the fixes, RMC the date (NMEA 0183, v4.11). Altitudes are
made ellipsoidal: GGA's altitude above the geoid plus its separation.
"""

from __future__ import annotations

import dataclasses
import datetime as dt
import functools
import operator
import re
from pathlib import Path

import numpy as np

from maplab_py.array_types import F64, I64, Mask
from maplab_py.errors import MapError, UserError
from maplab_py.input_files import read_text
from maplab_py.interop.stamps import FIXES
from maplab_py.interop.text_table import TextTable, parse_text_table

_MAX_BYTES = 500_000_000
_NAMES = (
    re.compile(r"lat(itude)?(_?deg)?"),
    re.compile(r"(lon|lng|long)(gitude|itude)?(_?deg)?"),
    re.compile(r"(alt(itude)?|height|ele(vation)?|h)(_?m)?"),
)
_SENTENCE = re.compile(
    r"\$(?P<body>[A-Z]{2}(?P<kind>GGA|RMC)),(?P<fields>[^*]*)\*(?P<sum>[0-9A-F]{2})"
)
_DAY_NS = 86_400_000_000_000


@dataclasses.dataclass(frozen=True, eq=False)
class GpsTrack:
    """Fixes on WGS 84 in the order of time."""

    times_ns: I64  # (N,)
    latitude_deg: F64  # (N,)
    longitude_deg: F64  # (N,) -180 .. 180
    altitude_m: F64  # (N,) above the ellipsoid
    source: str
    without_fix: int = 0  # sentences of a receiver that knew no position
    damaged: int = 0  # sentences with a wrong check sum

    def __len__(self) -> int:
        return len(self.times_ns)


def read_gps(path: Path, date: str = "", time_unit: str = "") -> GpsTrack:
    """Read fixes from CSV or NMEA, which is told from the content.

    Args:
        path: File. CSV has a header with latitude, longitude and altitude after the time stamp, or just
            these four columns [s or ns, deg, deg, m].
        date: Day of the first fix as YYYY-MM-DD, for NMEA without RMC sentences.
        time_unit: Unit of the time stamps of CSV; empty = see `stamps`.

    Raises:
        MapError: The file cannot be read or has no fixes; angles are no degrees; stamps go back.
        UserError: NMEA has no date and none is given, or it is none.
    """
    try:
        text = read_text(
            path, _MAX_BYTES, remedy="split it into parts", error=MapError, encoding="utf-8-sig"
        )
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise MapError(f"cannot read {path}: {reason}") from error
    is_nmea = text.lstrip().startswith(("$", "!"))
    track = _from_nmea(text, str(path), date) if is_nmea else _from_csv(text, str(path), time_unit)
    return check_track(track)


def check_track(track: GpsTrack) -> GpsTrack:
    """Return a track whose stamps increase.

    Raises:
        MapError: They do not.
    """
    backwards = np.flatnonzero(np.diff(track.times_ns) <= 0)
    if len(backwards):
        row = int(backwards[0]) + 1
        raise MapError(
            f"{track.source}: fix {row + 1} is not after the one before it ({track.times_ns[row]} ns): sort "
            "the file by time"
        )
    return track


def _from_csv(text: str, source: str, time_unit: str) -> GpsTrack:
    table = parse_text_table(text, source, FIXES, unit=time_unit)
    columns = _columns(table)
    lat, lon, alt = (table.values[:, column] for column in columns)
    _check_degrees(lat, lon, source, table.line_numbers)
    return GpsTrack(table.times_ns, lat, lon, alt, source)


def _columns(table: TextTable) -> list[int]:
    """Return the columns of latitude, longitude and altitude among the values."""
    width = table.values.shape[1]
    if len(table.header) == width + 1:
        names = table.header[1:]
        places = [[k for k, name in enumerate(names) if p.fullmatch(name)] for p in _NAMES]
        if all(places):
            return [matching[0] for matching in places]
    elif width == 3:
        return [0, 1, 2]
    raise MapError(
        f"{table.source}: no positions: a header with time, latitude, longitude and altitude is wanted, or "
        "these four columns"
    )


def _check_degrees(lat: F64, lon: F64, source: str, lines: I64) -> None:
    wrong = np.flatnonzero((np.abs(lat) > 90.0) | (np.abs(lon) > 180.0))
    if len(wrong):
        row = int(wrong[0])
        raise MapError(
            f"{source}:{lines[row]}: latitude {lat[row]:g}, longitude {lon[row]:g}: wants degrees, latitude "
            "first"
        )
    # a rectangle in the ocean off Africa
    if np.abs(lat).max() <= 0.5 * np.pi and np.abs(lon).max() <= np.pi:
        raise MapError(f"{source}: latitude and longitude look like radians: degrees are wanted")


def _from_nmea(text: str, source: str, date: str) -> GpsTrack:
    """Read GGA sentences; their day is that of the RMC sentence before or after them."""
    rows: list[tuple[int, float, float, float]] = []
    day_ns = _day_ns(date) if date else _first_date(text)
    without_fix, damaged = 0, 0
    for line in text.splitlines():
        if "GGA," not in line and "RMC," not in line:
            continue
        match = _SENTENCE.search(line)
        fields = match["fields"].split(",") if match is not None else []
        if match is None or not _is_intact(match):
            damaged += 1
            continue
        if match["kind"] == "RMC":
            named = _rmc_day_ns(fields)
            day_ns = day_ns if named is None or date else named
            continue
        if len(fields) < 11 or fields[5] in ("", "0"):
            without_fix += 1
            continue
        values = _gga(fields)
        if values is None:
            damaged += 1
            continue
        if day_ns is None:
            raise UserError(f"{source}: has no date (no RMC sentences): give --gps_date=YYYY-MM-DD")
        time_ns = day_ns + values[0]
        if rows and time_ns < rows[-1][0] - _DAY_NS // 2:  # past midnight without a new date
            day_ns += _DAY_NS
            time_ns += _DAY_NS
        if not rows or time_ns != rows[-1][0]:  # several talkers repeat a fix
            rows.append((time_ns, *values[1:]))
    if not rows:
        raise MapError(
            f"{source}: there are no fixes: {without_fix} sentences without position, {damaged} damaged"
        )
    times_ns = np.array([row[0] for row in rows], dtype=np.int64)
    lat, lon, alt = np.array([row[1:] for row in rows]).T
    return GpsTrack(times_ns, lat, lon, alt, source, without_fix, damaged)


def _is_intact(match: re.Match[str]) -> bool:
    content = f"{match['body']},{match['fields']}"
    return functools.reduce(operator.xor, content.encode(), 0) == int(match["sum"], 16)


def _gga(fields: list[str]) -> tuple[int, float, float, float] | None:
    """Return time of day [ns], latitude, longitude [deg] and ellipsoidal altitude [m], None if wrong."""
    try:
        lat = _degrees(fields[1], fields[2], "NS")
        lon = _degrees(fields[3], fields[4], "EW")
        altitude_m = float(fields[8]) + float(fields[10] or 0.0)
        return _time_of_day_ns(fields[0]), lat, lon, altitude_m
    except ValueError:
        return None


def _degrees(text: str, hemisphere: str, signs: str) -> float:
    """Return the degrees of dddmm.mmmm; ValueError if it is none."""
    sign = 1.0 if signs.index(hemisphere) == 0 else -1.0
    whole, minutes = divmod(float(text), 100.0)
    if not 0.0 <= minutes < 60.0 or not 0.0 <= whole <= 180.0:
        raise ValueError(text)
    return sign * (whole + minutes / 60.0)


def _time_of_day_ns(text: str) -> int:
    """Return the nanoseconds of hhmmss.sss; ValueError if it is none."""
    seconds, _, fraction = text.partition(".")
    if len(seconds) != 6:
        raise ValueError(text)
    whole = int(seconds[:2]) * 3600 + int(seconds[2:4]) * 60 + int(seconds[4:])
    return whole * 1_000_000_000 + int((fraction or "0").ljust(9, "0")[:9])


def _first_date(text: str) -> int | None:
    """Return the day [ns] of the first intact RMC sentence, which may follow the first fixes."""
    for match in _SENTENCE.finditer(text):
        if match["kind"] == "RMC" and _is_intact(match):
            day_ns = _rmc_day_ns(match["fields"].split(","))
            if day_ns is not None:
                return day_ns
    return None


def _rmc_day_ns(fields: list[str]) -> int | None:
    """Return the day [ns] of ddmmyy, None where a receiver does not know it."""
    try:
        day, month, year = (int(fields[8][k : k + 2]) for k in (0, 2, 4))
        return _day_ns(f"{2000 + year}-{month:02d}-{day:02d}")
    except (ValueError, IndexError, UserError):
        return None


def _day_ns(date: str) -> int:
    try:
        day = dt.date.fromisoformat(date)
    except ValueError as error:
        raise UserError(f"--gps_date={date}: wants a day as YYYY-MM-DD") from error
    return (day - dt.date(1970, 1, 1)).days * _DAY_NS


def east_north_up_m(
    track: GpsTrack, origin: tuple[float, float, float], rows: Mask | slice = slice(None)
) -> F64:
    """Return the positions (N, 3) east, north and up of an origin [deg, deg, m]."""
    from pymap3d import geodetic2enu

    east, north, up = geodetic2enu(
        track.latitude_deg[rows], track.longitude_deg[rows], track.altitude_m[rows], *origin
    )
    return np.stack([east, north, up], axis=1).astype(np.float64)
