"""Positions of satellite receivers: CSV with time, latitude, longitude and altitude, and NMEA 0183.

NMEA: sentences GGA of any talker have the fixes, or GNS where there are none, RMC and ZDA the date
(NMEA 0183, v4.11). Altitudes are made ellipsoidal: that above the geoid plus its separation. Rows that are
no fixes are left out and counted by reason.
"""

import datetime as dt
import functools
import operator
import re
from collections.abc import Set
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from maplab_py.array_types import F64, I64, NDArray, Rows
from maplab_py.errors import MapError, UserError
from maplab_py.input_files import decode_foreign, read_bytes
from maplab_py.interop.recordings import bag_files
from maplab_py.interop.stamps import FIXES
from maplab_py.interop.text_table import TextTable, parse_text_table

_MAX_BYTES = 500_000_000
_NAMES = (
    re.compile(r"(.*\.)?lat(itude)?(_?deg)?"),
    re.compile(r"(.*\.)?(lon|lng|long)(gitude|itude)?(_?deg)?"),
    re.compile(r"(.*\.)?(alt(itude)?|height|ele(vation)?|h)(_?m)?"),
)
_STATUS = re.compile(r"(.*\.)?(nav_?sat_?)?status(\.status)?")
_QUALITY = re.compile(r"(gps_?|fix_?)?(quality|fix_?type)")
_SENTENCE = re.compile(
    r"\$(?P<body>[A-Z]{2}(?P<kind>GGA|GNS|RMC|ZDA)),(?P<fields>[^*$]*)(\*(?P<sum>[0-9A-F]{2}))?",
    re.IGNORECASE,
)
_NMEA = re.compile(r"^.{0,80}[$!][A-Z]{2}[A-Z]{3},", re.IGNORECASE | re.MULTILINE)
_HEMISPHERE = re.compile(
    r"(?<![\w.+-])(\d+\.?\d*)(\s*[,;\s]?\s*)([NSEW])(?=\s*([,;\s]|$))", re.MULTILINE
)
"""Degrees and their hemisphere, as in "47.1,S" and "8.5W"."""
_FIXES = ("GGA", "GNS")
_LEAST_FIELDS = {"GGA": 14, "GNS": 12, "RMC": 9, "ZDA": 4}
"""Fields of a whole sentence, which is told by them where nothing has a check sum."""
_REASON = "<U40"
NO_FIX, ZERO, BEYOND = "without a fix", "latitude 0, longitude 0", "beyond 90 or 180 deg"
NO_NUMBER, DAMAGED, REPEATED = "not a finite number", "damaged", "repeated"
_MOST = 0.5
"""Share of fixes beyond all degrees from which the file has another unit or order."""
_DAY_NS = 86_400_000_000_000


class GpsTrack(Rows):
    """Fixes on WGS 84 in the order of time."""

    times_ns: I64  # (N,)
    latitude_deg: F64  # (N,)
    longitude_deg: F64  # (N,) -180 .. 180
    altitude_m: F64  # (N,) above the ellipsoid
    source: str
    left_out: tuple[tuple[str, int], ...] = ()  # reasons and their numbers of rows


def read_gps(path: Path, date: str = "", time_unit: str = "") -> GpsTrack:
    """Read fixes from CSV or NMEA, which is told from the content.

    Args:
        path: File. CSV has a header with latitude, longitude and altitude after the time stamp, or just
            these four columns [s or ns, deg, deg, m].
        date: Day of the first fix as YYYY-MM-DD, for NMEA without RMC and ZDA sentences.
        time_unit: Unit of the time stamps of CSV; empty = see `stamps`.

    Raises:
        MapError: The file cannot be read or has no fixes; angles are no degrees; stamps go back.
        UserError: NMEA has no date and none is given, or it is none.
    """
    try:
        content = read_bytes(path, _MAX_BYTES, remedy="split it into parts", error=MapError)
        text = decode_foreign(content)
    except OSError as error:
        raise MapError(f"cannot read {path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        text = content.decode("latin-1")  # receivers mix sentences with binary messages
        if not _SENTENCE.search(text):
            raise MapError(f"cannot read {path}: it is not text") from error
        return _from_nmea(text, str(path), date)
    if text.lstrip().startswith("<"):
        raise MapError(
            f"{path}: is XML, as GPX or KML: convert it to CSV with time, latitude, longitude and altitude"
        )
    if _NMEA.search(text):
        return _from_nmea(text, str(path), date)
    return _from_csv(text, str(path), time_unit)


def gps_track(
    times_ns: I64, fixes: F64, source: str, reasons: NDArray[np.str_], lines: I64 | None = None
) -> GpsTrack:
    """Return the fixes of a receiver without those that are none, in the order of time.

    Args:
        times_ns: Stamps (N,).
        fixes: Latitude, longitude [deg] and altitude [m] (N, 3).
        reasons: Why each row (N,) is known to be no fix; empty = it may be one.
        lines: Line of each row, for messages.

    Raises:
        MapError: None is left, angles are no degrees, or stamps go back.
    """
    reasons = reasons.astype(_REASON)
    known = reasons == ""
    degrees = fixes[:, :2]
    with np.errstate(invalid="ignore"):
        beyond = (np.abs(degrees) > (90.0, 180.0)).any(axis=1)
    reasons[known & beyond] = BEYOND
    reasons[known & (degrees == 0.0).all(axis=1)] = ZERO
    reasons[known & ~np.isfinite(fixes).all(axis=1)] = NO_NUMBER
    places = (
        [f": fix {row + 1}" for row in range(len(fixes))]
        if lines is None
        else [f":{n}" for n in lines]
    )
    given = np.count_nonzero(known & ~np.isin(reasons, (ZERO, NO_NUMBER)))
    if np.count_nonzero(reasons == BEYOND) > _MOST * given:
        row = int(np.argmax(reasons == BEYOND))
        raise MapError(
            f"{source}{places[row]}: latitude {degrees[row, 0]:g}, longitude {degrees[row, 1]:g}: wants "
            "degrees, latitude first"
        )
    _check_order(times_ns, fixes, np.flatnonzero(reasons == ""), source, places)
    kept = np.flatnonzero(reasons == "")
    reasons[kept[1:][np.diff(times_ns[kept]) == 0]] = REPEATED
    kept = np.flatnonzero(reasons == "")
    counts = zip(*np.unique(reasons[reasons != ""], return_counts=True), strict=True)
    left_out = sorted(
        ((str(name), int(count)) for name, count in counts), key=lambda item: -item[1]
    )
    if not len(kept):
        said = (
            ", ".join(f"{count} {reason}" for reason, count in left_out)
            or "no GGA or GNS sentences"
        )
        raise MapError(f"{source}: there are no fixes: {said}")
    lat, lon, alt = fixes[kept].T
    # a rectangle in the ocean off Africa
    if np.abs(lat).max() <= 0.5 * np.pi and np.abs(lon).max() <= np.pi:
        raise MapError(f"{source}: latitude and longitude look like radians: degrees are wanted")
    return GpsTrack(times_ns[kept], lat, lon, alt, source, tuple(left_out))


def _check_order(times_ns: I64, fixes: F64, kept: I64, source: str, places: list[str]) -> None:
    """Check that stamps do not go back, and that fixes of one stamp are equal.

    Raises:
        MapError: They are not.
    """
    steps = np.diff(times_ns[kept])
    differ = np.any(fixes[kept][1:] != fixes[kept][:-1], axis=1)
    wrong = np.flatnonzero((steps < 0) | ((steps == 0) & differ))
    if not len(wrong):
        return
    before, row = kept[wrong[0]], kept[wrong[0] + 1]
    if steps[wrong[0]] == 0:
        raise MapError(
            f"{source}{places[row]}: has the stamp {times_ns[row]} ns of the fix before it "
            f"({places[before][1:].strip()}) and another position: remove one of them"
        )
    raise MapError(
        f"{source}{places[row]}: is not after the one before it ({times_ns[row]} ns): sort the file by time"
    )


def _from_csv(text: str, source: str, time_unit: str) -> GpsTrack:
    text = _HEMISPHERE.sub(_signed, text)
    table = parse_text_table(text, source, FIXES, unit=time_unit, allow_nan=True)
    reasons = np.full(len(table.times_ns), "", dtype=_REASON)
    if table.names:
        for place, name in enumerate(table.names):
            if _STATUS.fullmatch(name):
                reasons[table.values[:, place] < 0.0] = f"{NO_FIX} (status -1)"
            elif _QUALITY.fullmatch(name):
                reasons[table.values[:, place] <= 0.0] = f"{NO_FIX} (quality 0)"
    places = _columns(table)
    fixes = np.append(table.values[:, places[:2]], table.columns(places[2:], "length"), axis=1)
    return gps_track(table.times_ns, fixes, source, reasons, table.line_numbers)


def _signed(match: re.Match[str]) -> str:
    """Return degrees with the sign of their hemisphere, whose letter stays if it is a cell of its own."""
    degrees, gap, letter, after = match.groups()
    is_cell = gap and (gap.strip() or after not in (",", ";"))
    return "-" * (letter in "SW") + degrees + (gap + letter) * bool(is_cell)


def _columns(table: TextTable) -> list[int]:
    """Return the columns of latitude, longitude and altitude among the values."""
    width = table.values.shape[1]
    if table.names:
        places = [[k for k, name in enumerate(table.names) if p.fullmatch(name)] for p in _NAMES]
        if all(places):
            return [matching[0] for matching in places]
    elif width == 3:
        return [0, 1, 2]
    raise MapError(
        f"{table.source}: no positions: a header with time, latitude, longitude and altitude is wanted, or "
        "these four columns"
    )


class _Sentence(NamedTuple):
    """Content of a sentence."""

    clock_ns: int | None  # time of day
    day_ns: int | None = None  # of RMC and ZDA
    is_valid: bool = False  # of a receiver with a fix, whose date is therefore right
    fix: tuple[float, float, float] | None = None  # of GGA and GNS
    reason: str = ""  # why it is none


def _from_nmea(text: str, source: str, date: str) -> GpsTrack:
    """Read sentences with fixes; the days follow their hours from those with dates, or from a given date."""
    given_ns = _day_ns(date) if date else None
    source_kind = next((kind for kind in _FIXES if re.search(f"{kind},", text, re.I)), _FIXES[0])
    wanted = re.compile(f"({source_kind}|RMC|ZDA),", re.IGNORECASE)
    lines = [line for line in text.splitlines() if wanted.search(line)]
    matches = [match for line in lines if (match := _SENTENCE.search(line)) is not None]
    summed = {match["kind"].upper() for match in matches if match["sum"]}
    sentences = [s for match in matches if (s := _parse(match, summed)) is not None]
    timed = [s for s in sentences if s.clock_ns is not None]
    is_fix = np.array([s.fix is not None for s in timed], dtype=np.bool_)
    times_ns = _times_ns(timed, is_fix, given_ns)
    if times_ns is None:
        raise UserError(
            f"{source}: has no date (no RMC or ZDA sentences): give --gps_date=YYYY-MM-DD"
        )
    times_ns = times_ns[is_fix]
    fixes = np.array([s.fix for s in timed if s.fix is not None], dtype=np.float64).reshape(-1, 3)
    reasons = np.full(len(fixes), "", dtype=_REASON)
    reasons[1:][np.diff(times_ns) == 0] = REPEATED  # by several talkers
    without = [s.reason for s in sentences if s.reason] + [DAMAGED] * (len(lines) - len(sentences))
    return gps_track(
        np.append(times_ns, np.zeros(len(without), dtype=np.int64)),
        np.append(fixes, np.full((len(without), 3), np.nan), axis=0),
        source,
        np.append(reasons, np.array(without, dtype=_REASON)),
    )


def _parse(match: re.Match[str], summed: Set[str]) -> _Sentence | None:
    """Return what a sentence tells, None if it is damaged; `summed` are the kinds with check sums."""
    fields, kind = match["fields"].strip().split(","), match["kind"].upper()
    if not (_is_intact(match) if kind in summed else len(fields) >= _LEAST_FIELDS[kind]):
        return None
    if kind in _FIXES and (len(fields) < 11 or not fields[5].upper().strip("0N")):
        return _Sentence(None, reason=NO_FIX)
    try:
        clock_ns = _time_of_day_ns(fields[0])
        if kind in _FIXES:
            return _Sentence(clock_ns, fix=_fix(fields, 10 if kind == "GGA" else 9))
    except ValueError:
        return None if kind in _FIXES else _Sentence(None)
    if kind == "ZDA":
        return _Sentence(clock_ns, _day_of("".join(fields[1:4])), fields[3] >= "2000")
    return _Sentence(
        clock_ns, _day_of(fields[8] if len(fields) > 8 else ""), fields[1].upper() == "A"
    )


def _times_ns(
    sentences: list[_Sentence], is_fix: NDArray[np.bool_], given_ns: int | None
) -> I64 | None:
    """Return the times (N,) of sentences, None without any date.

    Neighbours are less than half a day apart, unless the date says otherwise: so hours run over midnight,
    forwards from a date and backwards to what comes before the first.
    """
    clock_ns = np.array([s.clock_ns for s in sentences], dtype=np.int64)
    if not is_fix.any():
        return clock_ns
    half = _DAY_NS // 2
    running = clock_ns[:1] + np.append(0, np.cumsum((np.diff(clock_ns) + half) % _DAY_NS - half))
    if given_ns is not None:
        first = int(np.argmax(is_fix))
        return np.asarray(running + given_ns + clock_ns[first] - running[first])
    dated = [k for k, s in enumerate(sentences) if s.day_ns is not None]
    dated = [k for k in dated if sentences[k].is_valid] or dated
    if not dated:
        return None
    days = np.array([sentences[k].day_ns for k in dated], dtype=np.int64)
    offset = days + clock_ns[dated] - running[dated]
    last = np.searchsorted(dated, np.arange(len(sentences)), side="right") - 1
    return np.asarray(running + offset[np.maximum(last, 0)])


def _is_intact(match: re.Match[str]) -> bool:
    """Return whether the check sum is right, of the sentence as it is or in upper case."""
    content = f"{match['body']},{match['fields']}"
    sums = {functools.reduce(operator.xor, text.encode(), 0) for text in (content, content.upper())}
    return match["sum"] is not None and int(match["sum"], 16) in sums


def _fix(fields: list[str], separation: int) -> tuple[float, float, float]:
    """Return latitude, longitude [deg] and ellipsoidal altitude [m]; ValueError if they are none.

    The separation of the geoid is in the field of this number.
    """
    lat = _degrees(fields[1], fields[2].upper(), "NS")
    lon = _degrees(fields[3], fields[4].upper(), "EW")
    altitude_m = float(fields[8]) + float(fields[separation] or 0.0) if fields[8] else np.nan
    return lat, lon, altitude_m


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


def _day_of(date: str) -> int | None:
    """Return the day [ns] of ddmmyy or ddmmyyyy, None where a receiver does not know it."""
    try:
        day, month, year = int(date[:2]), int(date[2:4]), int(date[4:])
        return _day_ns(f"{year if year >= 100 else year + 2000}-{month:02d}-{day:02d}")
    except (ValueError, UserError):
        return None


def _day_ns(date: str) -> int:
    try:
        day = dt.date.fromisoformat(date)
    except ValueError as error:
        raise UserError(f"--gps_date={date}: wants a day as YYYY-MM-DD") from error
    return (day - dt.date(1970, 1, 1)).days * _DAY_NS


def east_north_up_m(track: GpsTrack, origin: tuple[float, float, float]) -> F64:
    """Return the positions (N, 3) east, north and up of an origin [deg, deg, m]."""
    from pymap3d import geodetic2enu

    east, north, up = geodetic2enu(
        track.latitude_deg, track.longitude_deg, track.altitude_m, *origin
    )
    return np.stack([east, north, up], axis=1).astype(np.float64)


# Positions of satellite receivers in bags of ROS 1 and ROS 2: sensor_msgs/NavSatFix.
#
# Source: sensor_msgs/NavSatFix and NavSatStatus: degrees and ellipsoidal altitude on WGS 84; a status
# below zero is a receiver without a fix.

NAV_SAT_FIX = "sensor_msgs/msg/NavSatFix"
_FIX_FROM = 0
"""Status of a fix without augmentation; -1 is none."""


def read_fixes(path: Path, date: str = "", topic: str = "", time_unit: str = "") -> GpsTrack:
    """Read fixes from a bag, or from CSV or NMEA; arguments and errors as in the readers of these.

    Raises:
        UserError: A topic is given for a file that is no bag.
    """
    if bag_files.is_bag(path):
        return read_gps_bag(path, topic)
    if topic:
        raise UserError(f"{path} is no bag: leave out --gps_topic={topic}")
    return read_gps(path, date, time_unit)


def read_gps_bag(path: Path, topic: str = "") -> GpsTrack:
    """Read the fixes of a topic; empty = the only one with fixes.

    Raises:
        UserError: It is no bag, or the topic does not exist or has something else.
        MapError: The bag or a message is damaged, there are no fixes, or stamps go back.
    """
    bag_files.check_bag(path, "--gps_file")
    rows: list[tuple[float, float, float]] = []
    stamps: list[int] = []
    reasons: list[str] = []
    with bag_files.opened_bag(path) as reader:
        types = bag_files.topic_types(reader)
        fixes_of = sorted(name for name, kind in types.items() if kind == NAV_SAT_FIX)
        asked = topic or (fixes_of[0] if len(fixes_of) == 1 else "")
        name = bag_files.topic_in_bag(path, types, asked, "--gps_topic", (NAV_SAT_FIX,))
        connections = [c for c in reader.connections if c.topic == name]
        for connection, _, data in bag_files.all_messages(path, reader, connections):
            message: Any = reader.deserialize(data, connection.msgtype)
            status = int(message.status.status)
            reasons.append(f"{NO_FIX} (status {status})" if status < _FIX_FROM else "")
            rows.append((message.latitude, message.longitude, message.altitude))
            stamps.append(bag_files.header_stamp_ns(data, is_ros_2=reader.is2))
    fixes = np.array(rows, dtype=np.float64).reshape(-1, 3)
    return gps_track(
        np.array(stamps, dtype=np.int64), fixes, f"{path}: {name}", np.array(reasons, dtype=np.str_)
    )
