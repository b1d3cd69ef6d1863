"""Trajectory files: TUM text, EuRoC / ASL ground truth, KITTI, and CSV with named columns.

TUM: `t[s] x y z qx qy qz qw`. EuRoC: `t[ns], p, q (w first), v, gyro bias, accel bias`. KITTI: the upper
three rows of a homogeneous matrix, row by row, with the time stamps in a file of their own.
"""

import dataclasses
import re
from itertools import chain
from pathlib import Path

import numpy as np

from maplab_py.array_types import F64, I64, Mask, NDArray, Rows
from maplab_py.errors import MapError
from maplab_py.geometry import se3, so3
from maplab_py.input_files import LARGEST, read_foreign_text
from maplab_py.interop import text_table
from maplab_py.interop.stamps import POSES, read_stamps
from maplab_py.output_files import write_text
from maplab_py.report import counted

_MAX_BYTES = 500_000_000
_ROUNDING = ((1e-4, 1e-2), (1e-4, 2e-2))
"""Least and largest difference [m], [rad] that rounded numbers make between rows of one pose; between
them half of what the body moves from row to row."""
_UNIT_TOLERANCE = 0.02
"""Largest deviation of a quaternion's norm from 1; accepts files with three digits."""
_KINDS = {
    "o": "q", "ori": "q", "rot": "q",
    "p": "p", "t": "p", "pos": "p", "position": "p", "translation": "p", "": "p",
    "q": "q", "quat": "q", "quaternion": "q", "orientation": "q", "rotation": "q",
    "v": "v", "vel": "v", "velocity": "v",
    "bw": "b_g", "bg": "b_g", "b_w": "b_g", "b_g": "b_g", "gyro bias": "b_g",
    "ba": "b_a", "b_a": "b_a", "acc bias": "b_a", "accel bias": "b_a",
}  # fmt: skip
_NAME = re.compile(
    r"(?:.*?\.)??(gyro bias|acc(?:el)? bias|orientation quaternion|position|pos|quaternion|quat|orientation"
    r"|rotation|ori|rot|translation|velocity|vel|b_?[wga]|[ptqvo])?(?:_[a-z0-9_]*?)?[_. ]?([wxyz])"
)
_TURN = re.compile(r"^q|quat|orient|rotation|^rot_?[xyz]")
_EUROC_ORDER = ("px", "py", "pz", "qw", "qx", "qy", "qz")
_EUROC_STATE = ("vx", "vy", "vz", *(f"b_g{i}" for i in "xyz"), *(f"b_a{i}" for i in "xyz"))
_KITTI_NUMBERS, _KITTI_HINT = 12, ", or KITTI's matrices with --times_file"
_VERTEX_TABLE, _LOCALIZED_IN_M = "p_m_ix", "p_mi_x"
_IN_M = ("q_m_i{}", "q_mi_{}")
LOCALIZED = "is_localized"
"""Column of rovioli's poses in a map: 0 where the frame was not localised and has no pose."""
_TUM_ORDER = ("px", "py", "pz", "qx", "qy", "qz", "qw")
_EUROC_HEADER = (
    "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], "
    "q_RS_z []"
)
_EUROC_STATE_HEADER = (
    ", v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1], "
    "b_w_RS_S_y [rad s^-1], b_w_RS_S_z [rad s^-1], b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], "
    "b_a_RS_S_z [m s^-2]"
)


class Trajectory(Rows):
    """Stamped poses of a body B in a reference frame R, in the order of time."""

    times_ns: I64  # (N,)
    T_R_B: F64  # (N, 7)
    v_R: F64 | None = None  # (N, 3) [m/s]
    gyro_bias: F64 | None = None  # (N, 3) [rad/s]
    accel_bias: F64 | None = None  # (N, 3) [m/s^2]
    source: str = ""
    note: str = ""  # one line on the unit of the stamps, where it was concluded
    has_orientation: bool = True  # else the quaternions are the identity


def read_trajectory(
    path: Path,
    time_unit: str = "",
    *,
    needs_orientation: bool = True,
    keep_repeated: bool = False,
) -> Trajectory:
    """Read a trajectory; the format is detected from the content.

    Columns are identified by the names in the header if there is one; without names, eight columns
    are TUM (quaternion w last), whole nanoseconds with commas are EuRoC (w first), and four are stamps
    and positions. Rows that repeat a pose are read once, unless `keep_repeated` is set: then every row is
    read, also those that contradict each other.

    Args:
        time_unit: Unit of the time stamps; empty = see `stamps`.

    Raises:
        MapError: The file cannot be read or is not a trajectory, two rows contradict each other, or there
            are positions only and `needs_orientation` is set; names file and line.
    """
    table = text_table.read_text_table(path, POSES, unit=time_unit)
    if LOCALIZED in table.header:
        table = table.take(table.values[:, table.header.index(LOCALIZED) - 1] > 0.0)
    trajectory = trajectory_of_table(table, keep_repeated=keep_repeated)[0]
    if table.has_commas and not table.names and table.unit != "ns" and trajectory.has_orientation:
        note = f"{path}: columns without names are read as t, x, y, z, qx, qy, qz, qw: a header names others"
        trajectory = dataclasses.replace(
            trajectory, note="; ".join(filter(None, (table.note, note)))
        )
    if needs_orientation and not trajectory.has_orientation:
        raise MapError(
            f"{path}: has positions without orientations, which are needed here: give qx, qy, qz and qw, too"
        )
    return trajectory


def trajectory_of_table(
    table: text_table.TextTable, *, keep_repeated: bool = False
) -> tuple[Trajectory, I64]:
    """Return the trajectory of a table, and the row of the table of each pose.

    Raises:
        MapError: As in `read_trajectory`.
    """
    names = _columns(table)
    p = table.columns([names[f"p{i}"] for i in "xyz"], "length")
    q = np.tile(so3.identity(), (len(p), 1))
    if "qw" in names:
        q = table.values[:, [names[f"q{i}"] for i in "xyzw"]]
        norm = np.linalg.norm(q, axis=1)
        _refuse(table, np.abs(norm - 1.0) > _UNIT_TOLERANCE, "the quaternion is not of unit length")
        q = q / norm[:, None]
    rows = np.arange(len(p))
    v_R = _optional(table, names, "v", "velocity")
    if _VERTEX_TABLE in table.header:  # the program's own table, of missions one after the other
        rows = np.argsort(table.times_ns, kind="stable")
    in_M = [
        [table.header.index(name.format(i)) - 1 for i in "xyzw"]
        for name in _IN_M
        if name.format("w") in table.header
    ]
    if in_M and v_R is not None:  # poses are in G and velocities in M
        v_R = so3.rotate(so3.multiply(q, so3.inverse(table.values[:, in_M[0]])), v_R)
    backwards = np.diff(table.times_ns[rows], prepend=table.times_ns[rows[0]]) < 0
    _refuse(
        table, backwards, "the time stamp lies before that of the row above: sort the rows by time"
    )
    trajectory = Trajectory(
        table.times_ns,
        np.concatenate([q, p], axis=1),
        v_R,
        _optional(table, names, "b_g", "rate"),
        _optional(table, names, "b_a", "acceleration"),
        table.source,
        table.note,
        "qw" in names,
    )
    if not keep_repeated:
        rows = rows[_distinct(trajectory, rows, table.line_numbers)]
    return trajectory.take(rows), rows


def _distinct(trajectory: Trajectory, rows: I64, lines: I64) -> Mask:
    """Return which rows (N,), in the order of time, begin a new stamp; the others repeat a pose."""
    stamps, T = trajectory.times_ns[rows], trajectory.T_R_B[rows]
    is_new = np.append(True, np.diff(stamps) != 0)
    first = np.maximum.accumulate(np.where(is_new, np.arange(len(rows)), 0))
    if is_new.all():
        return is_new
    apart, step = se3.local(T[first], T), se3.local(T[:-1], T[1:])
    wrong = np.zeros(len(rows), dtype=np.bool_)
    for k, bounds in zip((0, 3), _ROUNDING, strict=True):
        usual = (
            np.median(np.linalg.norm(step[is_new[1:], k : k + 3], axis=1)) if any(is_new[1:]) else 0
        )
        wrong |= np.linalg.norm(apart[:, k : k + 3], axis=1) > np.clip(0.5 * usual, *bounds)
    if wrong.any():
        row = int(np.argmax(wrong))
        apart_m, apart_deg = (
            np.linalg.norm(apart[row, :3]),
            np.degrees(np.linalg.norm(apart[row, 3:])),
        )
        raise MapError(
            f"{trajectory.source}:{lines[rows[row]]}: has the time stamp of line {lines[rows[first[row]]]}, "
            f"but another pose, {apart_m:.3g} m and {apart_deg:.3g} deg away: remove one of the two "
            f"({counted(int(wrong.sum()), 'such row')})"
        )
    return is_new


def read_kitti(path: Path, times_file: Path, time_unit: str = "") -> Trajectory:
    """Read poses of KITTI's odometry benchmark and their time stamps, in seconds by custom.

    Raises:
        MapError: A file cannot be read, a line is no pose or time stamp, or their numbers differ.
    """
    matrices = _numbers(path, _KITTI_NUMBERS, "a pose of KITTI (3 x 4 numbers)").reshape(-1, 3, 4)
    stamps = read_stamps(times_file, POSES, unit=time_unit)
    times_ns = stamps.times_ns
    if len(times_ns) != len(matrices):
        raise MapError(
            f"{times_file} has {len(times_ns)} time stamps, {path} {len(matrices)} poses"
        )
    R = matrices[:, :, :3]
    error = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2))
    wrong = np.flatnonzero((error > _UNIT_TOLERANCE) | (np.linalg.det(R) < 0.0))
    if len(wrong):
        raise MapError(f"{path}: pose {wrong[0] + 1} is no rotation and position")
    if np.any(np.diff(times_ns) < 0):
        raise MapError(f"{times_file}: the time stamps are not in the order of time")
    T_R_B = se3.make(so3.from_matrix(R), matrices[:, :, 3])
    return Trajectory(times_ns, T_R_B, source=str(path), note=stamps.note)


def _numbers(path: Path, width: int, what: str) -> F64:
    """Return the rows (N, width) of a file of numbers without stamps."""
    rows = [line.split() for line in read_foreign_text(path, _MAX_BYTES).splitlines()]
    wrong = [number for number, row in enumerate(rows, 1) if row and len(row) != width]
    if wrong:
        raise MapError(f"{path}:{wrong[0]}: {what} is wanted")
    try:
        values = np.array([row for row in rows if row], dtype=np.float64).reshape(-1, width)
    except ValueError as error:
        raise MapError(f"{path}: {what} is wanted per line: {error}") from None
    if not len(values) or not np.all(np.abs(values) <= LARGEST):
        raise MapError(f"{path}: {what} is wanted per line")
    return values


def write_tum(trajectory: Trajectory, path: Path, *, overwrite: bool = False) -> None:
    """Write a TUM file; poses read back bit-identical.

    Raises:
        UserError: The file exists and `overwrite` is not set, or it cannot be written.
    """
    T = trajectory.T_R_B
    columns = [*np.divmod(trajectory.times_ns, 1_000_000_000), T[:, 4:], T[:, :4]]
    write_text(path, text_table.format_rows("%d.%09d" + " %.17g" * 7, columns), overwrite=overwrite)


def write_euroc(trajectory: Trajectory, path: Path, *, overwrite: bool = False) -> None:
    """Write EuRoC ground truth; with velocity and biases where the trajectory has all of them.

    Raises:
        UserError: The file exists and `overwrite` is not set, or it cannot be written.
    """
    T = trajectory.T_R_B
    columns: list[NDArray[np.float64] | I64] = [trajectory.times_ns, T[:, 4:], T[:, [3, 0, 1, 2]]]
    state = [trajectory.v_R, trajectory.gyro_bias, trajectory.accel_bias]
    given = [part for part in state if part is not None]
    header, width = _EUROC_HEADER, 7
    if len(given) == 3:
        columns, header, width = [*columns, *given], header + _EUROC_STATE_HEADER, 16
    rows = text_table.format_rows("%d" + ",%.17g" * width, columns)
    write_text(path, chain([header + "\n"], rows), overwrite=overwrite)


def _columns(table: text_table.TextTable) -> dict[str, int]:
    """Return the place of each quantity ("px", "qw", "b_gx", ...) among the value columns.

    Raises:
        MapError: There is no position, or some of the columns of an orientation.
    """
    width = table.values.shape[1]
    names = _named_columns(table)
    if not names and not (table.names and table.has_commas):
        order: tuple[str, ...] = ()
        if table.has_commas and table.unit == "ns" and width >= 7:
            order = _EUROC_ORDER + (_EUROC_STATE if width >= 16 else ())
        elif width in (3, 7):
            order = _TUM_ORDER[:width]
        names = {name: place for place, name in enumerate(order)}
    turns = any(name[0] == "q" for name in names) or any(map(_TURN.search, table.header))
    wanted = _TUM_ORDER if turns else _TUM_ORDER[:3]
    missing = [name for name in wanted if name not in names]
    if missing:
        raise MapError(
            f"{table.source}: no trajectory: there is no column for {', '.join(missing)}; TUM (t x y z qx "
            "qy qz qw), EuRoC (t, p, q wxyz), positions (t x y z) or a header with such names is expected"
            + _KITTI_HINT
            * (width == _KITTI_NUMBERS - 1)
        )
    return names


def _named_columns(table: text_table.TextTable) -> dict[str, int]:
    """Return the columns that the header names; nothing without one.

    Names that tell the quantity come before those of an axis alone, as position.x before linear.x.

    Raises:
        MapError: Two columns have the same meaning, or the first is no time stamp.
    """
    if {_VERTEX_TABLE, _LOCALIZED_IN_M} & set(table.header):  # own tables: poses in G come first
        meanings = [_meaning(name) for name in table.names]
        names = {meaning: meanings.index(meaning) for meaning in meanings if meaning}
    else:
        names = table.places(lambda name: _meaning(name, is_explicit=True))
        if "px" not in names:
            names = {**table.places(_meaning), **names}
    if names and not text_table.is_time_name(table.header[0]):
        raise MapError(
            f"{table.source}: the first column must be the time stamp, not '{table.header[0]}'"
        )
    return names


def _meaning(name: str, *, is_explicit: bool = False) -> str:
    """Return the quantity that a name means, as "px"; empty for others, and for axes alone if asked."""
    match = _NAME.fullmatch(name)
    if match is None or (is_explicit and not match[1]):
        return ""
    return _KINDS[(match[1] or "").replace("orientation quaternion", "q")] + match[2]


def _optional(
    table: text_table.TextTable, names: dict[str, int], kind: str, quantity: str
) -> F64 | None:
    places = [names.get(f"{kind}{axis}") for axis in "xyz"]
    present = [place for place in places if place is not None]
    return table.columns(present, quantity) if len(present) == 3 else None


def _refuse(table: text_table.TextTable, wrong: NDArray[np.bool_], reason: str) -> None:
    if np.any(wrong):
        line = table.line_numbers[int(np.flatnonzero(wrong)[0])]
        raise MapError(f"{table.source}:{line}: {reason}")
