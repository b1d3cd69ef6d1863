"""Trajectories as files: TUM text, EuRoC / ASL ground truth, and CSV with named columns.

TUM: `t[s] x y z qx qy qz qw`. EuRoC: `t[ns], p, q (w first), v, gyro bias, accel bias`.
"""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from maplab_py.errors import MapError
from maplab_py.interop.text_table import (
    TextTable,
    format_rows,
    read_text_table,
    seconds_text,
)
from maplab_py.output_files import write_text

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

_UNIT_TOLERANCE = 0.02
"""Largest deviation of a quaternion's length from 1: files with three digits pass."""
_KINDS = {
    "p": "p", "t": "p", "pos": "p", "position": "p", "": "p",
    "q": "q", "quat": "q", "quaternion": "q", "orientation": "q",
    "v": "v", "vel": "v", "velocity": "v",
    "bw": "b_g", "bg": "b_g", "b_w": "b_g", "b_g": "b_g", "gyro bias": "b_g",
    "ba": "b_a", "b_a": "b_a", "acc bias": "b_a", "accel bias": "b_a",
}  # fmt: skip
_NAME = re.compile(
    r"(gyro bias|acc(?:el)? bias|orientation quaternion|position|pos|quaternion|quat|orientation"
    r"|velocity|vel|b_?[wga]|[ptqv])?(?:_[a-z0-9_]*?)?[_ ]?([wxyz])"
)
_EUROC_ORDER = ("px", "py", "pz", "qw", "qx", "qy", "qz")
_EUROC_STATE = ("vx", "vy", "vz", *(f"b_g{i}" for i in "xyz"), *(f"b_a{i}" for i in "xyz"))
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


@dataclasses.dataclass(frozen=True, eq=False)
class Trajectory:
    """Stamped poses of a body B in a reference frame R, in the order of time."""

    times_ns: I64  # (N,)
    T_R_B: F64  # (N, 7)
    v_R: F64 | None = None  # (N, 3) [m/s]
    gyro_bias: F64 | None = None  # (N, 3) [rad/s]
    accel_bias: F64 | None = None  # (N, 3) [m/s^2]
    source: str = ""

    def __len__(self) -> int:
        return len(self.times_ns)


def read_trajectory(path: Path) -> Trajectory:
    """Read a trajectory; the format is told from the content.

    Columns are found by the names in the header where there is one; without names, eight columns
    are TUM (quaternion w last), whole nanoseconds with commas are EuRoC (w first).

    Raises:
        MapError: The file cannot be read or is no trajectory; names file and line.
    """
    table = read_text_table(path)
    names = _columns(table)
    missing = [name for name in _TUM_ORDER if name not in names]
    if missing:
        raise MapError(
            f"{path}: no trajectory: there is no column for {', '.join(missing)}; TUM (t x y z qx "
            "qy qz qw), EuRoC (t, p, q wxyz) or a header with such names is wanted"
        )
    q = table.values[:, [names[f"q{i}"] for i in "xyzw"]]
    norm = np.linalg.norm(q, axis=1)
    _refuse(table, np.abs(norm - 1.0) > _UNIT_TOLERANCE, "the quaternion is not of unit length")
    backwards = np.diff(table.times_ns, prepend=table.times_ns[0]) < 0
    _refuse(table, backwards, "the time stamp lies before that of the row above")
    p = table.values[:, [names[f"p{i}"] for i in "xyz"]]
    return Trajectory(
        times_ns=table.times_ns,
        T_R_B=np.concatenate([q / norm[:, None], p], axis=1),
        v_R=_optional(table, names, "v"),
        gyro_bias=_optional(table, names, "b_g"),
        accel_bias=_optional(table, names, "b_a"),
        source=str(path),
    )


def write_tum(trajectory: Trajectory, path: Path, *, overwrite: bool = False) -> None:
    """Write a TUM file; poses read back bit-identical.

    Raises:
        UserError: The file exists and `overwrite` is not set, or it cannot be written.
    """
    T = trajectory.T_R_B
    columns = [*seconds_text(trajectory.times_ns), T[:, 4:], T[:, :4]]
    write_text(path, format_rows("%d.%09d" + " %.17g" * 7, columns), overwrite=overwrite)


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
    rows = format_rows("%d" + ",%.17g" * width, columns)
    write_text(
        path, (text for part in ([header + "\n"], rows) for text in part), overwrite=overwrite
    )


def _columns(table: TextTable) -> dict[str, int]:
    """Return the place of each quantity ("px", "qw", "b_gx", ...) among the value columns."""
    if len(table.header) == table.values.shape[1] + 1:
        if not re.search(r"time|stamp|^t$|sec|^ns$", table.header[0]):
            raise MapError(
                f"{table.source}: the first column must be the time stamp, not '{table.header[0]}'"
            )
        named: dict[str, int] = {}
        for place, name in enumerate(table.header[1:]):
            match = _NAME.fullmatch(name)
            if match is not None:
                prefix = (match[1] or "").replace("orientation quaternion", "q")
                named.setdefault(_KINDS[prefix] + match[2], place)
        if all(name in named for name in _TUM_ORDER):
            return named
    width = table.values.shape[1]
    if table.has_commas and table.is_nanoseconds and width >= 7:
        order = _EUROC_ORDER + (_EUROC_STATE if width >= 16 else ())
        return {name: place for place, name in enumerate(order)}
    if width == 7:
        return {name: place for place, name in enumerate(_TUM_ORDER)}
    return {}


def _optional(table: TextTable, names: dict[str, int], kind: str) -> F64 | None:
    places = [names.get(f"{kind}{axis}") for axis in "xyz"]
    found = [place for place in places if place is not None]
    return table.values[:, found] if len(found) == 3 else None


def _refuse(table: TextTable, wrong: NDArray[np.bool_], reason: str) -> None:
    if np.any(wrong):
        line = table.line_numbers[int(np.flatnonzero(wrong)[0])]
        raise MapError(f"{table.source}:{line}: {reason}")
