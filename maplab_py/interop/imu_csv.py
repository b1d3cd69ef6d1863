"""IMU recordings in EuRoC's form: `t[ns], gyro x y z [rad/s], accel x y z [m/s^2]`, or with named columns."""

import dataclasses
import re
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from maplab_py.errors import MapError
from maplab_py.interop import stamps, text_table
from maplab_py.output_files import write_text

_HEADER = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]\n"
)
_NAME = re.compile(
    r"(?:.*?\.)??(?:(?P<accel>a|acc|accel|accelerometer|acceleration|alpha"
    r"|lin(?:ear)?[_ ]?acc(?:el(?:eration)?)?)"
    r"|(?P<gyro>w|g|gyr|gyro|gyroscope|omega|ang(?:ular)?[_ ]?(?:vel(?:ocity)?|rate)))"
    r"(?:_[a-z0-9_]*?)?[_. ]?(?P<axis>[xyz])"
)
_GRAVITY_MPS2, _SLOW_RADPS = (7.0, 13.0), 4.0
"""Means of accelerations with gravity, and of rates that are none."""
_ORDER = [f"{sensor}{axis}" for sensor in ("accel", "gyro") for axis in "xyz"]


@dataclasses.dataclass(frozen=True, eq=False)
class ImuRecording:
    """IMU samples in the order of time, columns as in the map's `ImuSamples`."""

    times_ns: NDArray[np.int64]  # (N,)
    accel_gyro: NDArray[np.float64]  # (N, 6) [ax ay az gx gy gz], m/s^2 and rad/s
    lines: NDArray[np.int64] | None = None  # (N,) of the file, from 1
    note: str = ""  # one line on the unit of the stamps, where it was concluded


def read_imu_csv(path: Path, time_unit: str = "", *, in_order: bool = True) -> ImuRecording:
    """Read a table of IMU samples: columns as their names say, without names those of EuRoC.

    Args:
        time_unit: Unit of the time stamps; empty = see `stamps`.
        in_order: Refuse stamps that do not increase.

    Raises:
        MapError: The file cannot be read, has other columns, or its stamps do not increase.
    """
    table = text_table.read_text_table(path, stamps.IMU, unit=time_unit)
    places = _places(table)
    values = [
        table.columns(part, quantity)
        for part, quantity in ((places[:3], "acceleration"), (places[3:], "rate"))
    ]
    late = np.flatnonzero(np.diff(table.times_ns) <= 0)
    if in_order and len(late):
        line = table.line_numbers[late[0] + 1]
        raise MapError(
            f"{path}:{line}: the time stamp does not come after that of the row above: sort the rows or "
            "remove this one"
        )
    note = table.note
    if not table.places(_meaning) and places[0] == 0:
        first = "columns without names: accelerations come first, as gravity shows"
        note = "; ".join(filter(None, (note, f"{path}: {first}")))
    return ImuRecording(table.times_ns, np.concatenate(values, axis=1), table.line_numbers, note)


def _places(table: text_table.TextTable) -> list[int]:
    """Return the places of accelerations and rates, x y z each, among the columns of values.

    Raises:
        MapError: Names or number of the columns do not tell them.
    """
    places = table.places(_meaning)
    if all(name in places for name in _ORDER):
        return [places[name] for name in _ORDER]
    width = table.values.shape[1]
    axes = [name for name in table.names if re.search(r"[xyz]$", name)]
    if width != 6 or axes:
        raise MapError(
            f"{table.source}: 7 columns are expected (time, gyroscope xyz, accelerometer xyz), or names as "
            f"w_x, w_y, w_z, a_x, a_y, a_z in the header; "
            + (f"it has {', '.join(axes)}" if axes else f"not {width + 1}")
        )
    first, last = (float(np.mean(np.linalg.norm(v, axis=1))) for v in np.hsplit(table.values, 2))
    is_accel_first = _GRAVITY_MPS2[0] < first < _GRAVITY_MPS2[1] and last < _SLOW_RADPS
    return [0, 1, 2, 3, 4, 5] if is_accel_first else [3, 4, 5, 0, 1, 2]


def _meaning(name: str) -> str:
    """Return sensor and axis that a name means, as "gyrox"; empty for others."""
    match = _NAME.fullmatch(name)
    if match is None:
        return ""
    return ("accel" if match["accel"] else "gyro") + match["axis"]


def write_imu_csv(recording: ImuRecording, path: Path, *, overwrite: bool = False) -> None:
    """Write an EuRoC IMU file; values read back bit-identical.

    Raises:
        UserError: The file exists and `overwrite` is not set, or it cannot be written.
    """
    values = recording.accel_gyro[:, [3, 4, 5, 0, 1, 2]]
    rows = text_table.format_rows("%d" + ",%.17g" * 6, [recording.times_ns, values])
    write_text(path, chain([_HEADER], rows), overwrite=overwrite)
