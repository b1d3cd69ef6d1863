"""Wheel odometry in CSV: poses, motions since the row before, or velocities, by the names of the columns.

| columns | rows are |
|---|---|
| x, y, yaw; or x, y, z, qx, qy, qz, qw | poses in any frame of the wheels' own |
| dx, dy, dyaw; or dx, dy, dz, dqx, dqy, dqz, dqw | poses in the frame of the row before |
| vx, vy, wz; or vx, vy, vz, wx, wy, wz | velocities of the wheels in their own frame |

Columns of movements sideways (y, dy, vy) may be missing. Angles are radians, distances metres, unless the
header says otherwise.
"""

import re
from pathlib import Path

import numpy as np

from maplab_py.array_types import F64, I64, Rows
from maplab_py.errors import MapError
from maplab_py.geometry import se3, so3
from maplab_py.interop import stamps, text_table

_MAX_RATE_RADPS = 30.0
"""Faster turns are degrees per second, or nothing that wheels do."""
_PERCENTILE = 90.0
_ALIASES = {
    "px": "x", "py": "y", "pz": "z", "p_x": "x", "p_y": "y", "p_z": "z",
    "theta": "yaw", "heading": "yaw", "dtheta": "dyaw",
    "q_x": "qx", "q_y": "qy", "q_z": "qz", "q_w": "qw",
    "v": "vx", "v_x": "vx", "v_y": "vy", "v_z": "vz", "linear_x": "vx", "linear_y": "vy",
    "w": "wz", "omega": "wz", "w_x": "wx", "w_y": "wy", "w_z": "wz", "angular_z": "wz",
}  # fmt: skip
_ROS = re.compile(r"(?:.*\.)?(position|orientation|linear|angular)\.([wxyz])")
_ROS_KINDS = {"position": "", "orientation": "q", "linear": "v", "angular": "w"}
_PLANAR = {
    "poses": ("x", "y", "yaw"),
    "motions": ("dx", "dy", "dyaw"),
    "velocities": ("vx", "vy", "wz"),
}
_SPATIAL = {
    "poses": ("x", "y", "z", "qx", "qy", "qz", "qw"),
    "motions": ("dx", "dy", "dz", "dqx", "dqy", "dqz", "dqw"),
    "velocities": ("vx", "vy", "vz", "wx", "wy", "wz"),
}
_OPTIONAL = {"y", "dy", "vy"}
_UNIT_TOLERANCE = 1e-2


class WheelTrack(Rows):
    """Poses of the wheel sensor S in a frame O of its own, as far as the wheels know."""

    times_ns: I64  # (N,)
    T_O_S: F64  # (N, 7)
    is_planar: bool  # height, roll and pitch were not measured
    kind: str  # poses, motions or velocities
    source: str
    note: str = ""  # one line on the unit of the stamps, where it was concluded


def read_wheel_odometry(path: Path, time_unit: str = "") -> WheelTrack:
    """Read wheel odometry; what the rows are follows from the names of the columns.

    Raises:
        MapError: The file cannot be read, has no such columns or fewer than two rows, stamps do not
            increase, a quaternion is none, or turns are not in radians.
    """
    table = text_table.read_text_table(path, stamps.WHEELS, unit=time_unit)
    kind, is_planar, columns = _columns(table)
    backwards = np.flatnonzero(np.diff(table.times_ns) <= 0)
    if len(backwards):
        row = int(backwards[0]) + 1
        raise MapError(
            f"{path}:{table.line_numbers[row]}: its time stamp ({table.times_ns[row]} ns) is not after that "
            "of the row before: sort the file by time"
        )
    if len(table.times_ns) < 2:
        raise MapError(f"{path}: wheel odometry needs two rows, and there is one")
    if kind == "velocities":
        T = _integrated(table, columns, is_planar=is_planar)
    else:
        T = _poses(table, columns, is_planar=is_planar)
        T = accumulated(T) if kind == "motions" else T
    track = WheelTrack(table.times_ns, T, is_planar, kind, str(path), table.note)
    angular = columns[:, 2:] if is_planar else columns[:, 3:]
    _check_turns(track, angular if kind == "velocities" else None)
    return track


def accumulated(T_A_B: F64) -> F64:
    """Return the products T_0, T_0 T_1, T_0 T_1 T_2, ... of poses (N, 7), in log N rounds."""
    product, step = np.array(T_A_B), 1
    while step < len(product):
        product[step:] = se3.compose(product[:-step], product[step:])
        step *= 2
    return product


def _columns(table: text_table.TextTable) -> tuple[str, bool, F64]:
    """Return what the rows are, whether they are planar, and the columns (N, 3, 6 or 7)."""
    names = [_ALIASES.get(name, _of_ros(name)) for name in table.names]
    for is_planar, kinds in ((False, _SPATIAL), (True, _PLANAR)):
        for kind, wanted in kinds.items():
            if set(wanted) - set(names) <= (_OPTIONAL if is_planar else set()):
                zero = np.zeros(len(table.times_ns))
                values = [
                    table.columns([names.index(n)], _quantity(n))[:, 0] if n in names else zero
                    for n in wanted
                ]
                return kind, is_planar, np.stack(values, axis=1)
    raise MapError(
        f"{table.source}: no wheel odometry: a header is wanted that names, after the time stamp, x, y, yaw "
        "or dx, dy, dyaw or vx, vy, wz"
    )


def _of_ros(name: str) -> str:
    """Return the name of a column of nav_msgs/Odometry or geometry_msgs/Twist; others as they are."""
    match = _ROS.fullmatch(name)
    return name if match is None else _ROS_KINDS[match[1]] + match[2]


def _quantity(name: str) -> str:
    """Return which of the quantities of tables a column has."""
    if name.removeprefix("d").startswith("q"):
        return "number"
    return {"v": "velocity", "w": "rate"}.get(name[0], "angle" if "yaw" in name else "length")


def _poses(table: text_table.TextTable, columns: F64, *, is_planar: bool) -> F64:
    if is_planar:
        turn = np.zeros((len(columns), 3))
        turn[:, 2] = columns[:, 2]
        return se3.make(so3.exp(turn), np.column_stack([columns[:, :2], np.zeros(len(columns))]))
    length = np.linalg.norm(columns[:, 3:], axis=1)
    wrong = np.flatnonzero(np.abs(length - 1.0) > _UNIT_TOLERANCE)
    if len(wrong):
        raise MapError(
            f"{table.source}:{table.line_numbers[wrong[0]]}: the quaternion has the length "
            f"{length[wrong[0]]:g}, and wants 1"
        )
    return se3.make(columns[:, 3:] / length[:, None], columns[:, :3])


def _integrated(table: text_table.TextTable, columns: F64, *, is_planar: bool) -> F64:
    """Integrate velocities that change linearly between rows; the mean acts along a screw."""
    twist = np.zeros((len(columns), 6))
    twist[:, [0, 1, 5] if is_planar else slice(None)] = columns
    mean = 0.5 * (twist[1:] + twist[:-1])
    seconds = np.diff(table.times_ns) * 1e-9
    return np.concatenate([se3.identity(1), accumulated(se3.exp(mean * seconds[:, None]))])


def _check_turns(track: WheelTrack, velocities: F64 | None) -> None:
    """Check that most turns are slower than any that are in radians.

    Args:
        velocities: Angular velocities (N, 1 or 3) where these were measured.
    """
    if velocities is not None:
        rate = np.linalg.norm(velocities, axis=1)
    else:
        turn = so3.log(se3.relative(track.T_O_S[:-1], track.T_O_S[1:])[:, :4])
        rate = np.linalg.norm(turn, axis=1) / (np.diff(track.times_ns) * 1e-9)
    usual = float(np.percentile(rate, _PERCENTILE))
    if usual > _MAX_RATE_RADPS:
        raise MapError(
            f"{track.source}: turns at {usual:.0f} rad/s: angles in radians and time stamps in s or ns are "
            "wanted"
        )
