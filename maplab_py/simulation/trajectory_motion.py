"""Motion along a recorded trajectory: a spline through its poses; the spline is the truth."""

from pathlib import Path

import numpy as np

from maplab_py.array_types import F64
from maplab_py.errors import MapError, UserError
from maplab_py.geometry import se3, so3
from maplab_py.geometry.interpolation import interpolate_poses
from maplab_py.interop.trajectories import Trajectory, read_trajectory
from maplab_py.simulation.scenario import SessionOptions, WorldOptions
from maplab_py.simulation.spline import PoseSpline

KNOT_SPACING_S = 0.1
_RECORDED_KNOT_SPACING_S = 0.05
"""Beside recorded IMU samples, which feel the vibrations that wider knots leave out: with EuRoC's
V1_01 a turn within 0.05 s then agrees with the gyroscope to 0.008 deg in place of 0.07 deg."""
_ROUNDS = 60
"""Each iteration reduces the error at the knots by a factor of at most 2/3: 60 leave 3e-11."""
_MAX_GAP_NS = 1_000_000_000


def trajectory_spline(
    options: SessionOptions, world: WorldOptions, together: tuple[SessionOptions, ...] = ()
) -> PoseSpline:
    """Return the spline through a trajectory file, set into the middle of the first room.

    `duration_s` seconds from `trajectory_start_s` on are used. The body begins at `height_m`, its
    heading is the file's. Control poses are those of the file every 0.1 s (0.05 s with recorded IMU
    samples); between them the spline is smoother than the file.

    Args:
        world: Determines where the middle is.
        together: Sessions that share a frame, with this one: the middle is that of all, and the
            first of them begins at its `height_m`. None = the session is placed by itself.

    Raises:
        UserError: A file is no trajectory, is too short, or has gaps of more than a second.
    """
    spacing_s = _RECORDED_KNOT_SPACING_S if options.recorded_imu else KNOT_SPACING_S
    poses = _resample(options, spacing_s)
    placed = [_resample(session, KNOT_SPACING_S) for session in together] or [poses]
    first = together[0] if together else options
    poses[:, 4:] += _shift(placed, first, world)
    return through(poses, spacing_s)


def read_motion(options: SessionOptions) -> Trajectory:
    """Read the trajectory file of a session.

    Raises:
        UserError: The file is no trajectory.
    """
    try:
        return read_trajectory(Path(options.trajectory))
    except MapError as error:
        raise UserError(f"sessions.trajectory: {error}") from None


def through(poses: F64, spacing_s: float) -> PoseSpline:
    """Return the spline that passes through poses (N, 7) at multiples of `spacing_s` from 0.

    The control poses are computed iteratively: the error of the spline at its knots is added
    to them. The value at a knot is 2/3 of its control pose and 1/6 of each neighbour's, so every
    round shrinks the error by a factor between 0 and 2/3.
    """
    lead, trail = _beyond(poses[1], poses[0]), _beyond(poses[-2], poses[-1])
    target = np.concatenate([lead[None], poses, trail[None], _beyond(poses[-1], trail)[None]])
    control = target.copy()
    knots = np.arange(len(poses)) * spacing_s
    for _ in range(_ROUNDS):
        missed = se3.local(PoseSpline(control, spacing_s).evaluate(knots).T_G_I, poses)
        control[1 : len(poses) + 1] = se3.retract(control[1 : len(poses) + 1], missed)
        control[0] = _beyond(control[2], control[1])
        control[-2] = _beyond(control[-4], control[-3])
        control[-1] = _beyond(control[-3], control[-2])
    return PoseSpline(control, spacing_s)


def _beyond(before: F64, last: F64) -> F64:
    """Return the pose (7,) that goes on from `before` over `last` as far again."""
    turn = so3.multiply(so3.inverse(before[:4]), last[:4])
    q = so3.normalize(so3.multiply(last[:4], turn))
    return np.concatenate([q, 2.0 * last[4:] - before[4:]])


def _resample(options: SessionOptions, spacing_s: float) -> F64:
    """Return the poses (N, 7) of the file at multiples of a time from the start."""
    trajectory, duration_s = read_motion(options), options.duration_s
    times, first = np.unique(trajectory.times_ns, return_index=True)
    start_ns = times[0] + round(options.trajectory_start_s * 1e9)
    seconds = min(duration_s + 2.0 * spacing_s, (times[-1] - start_ns) * 1e-9)
    count = int(seconds / spacing_s) + 1
    if seconds < duration_s or count < 4:
        after = f" after {options.trajectory_start_s:g} s" if options.trajectory_start_s else ""
        raise UserError(
            f"sessions.duration_s: {trajectory.source} lasts {(times[-1] - start_ns) * 1e-9:.1f} s"
            f"{after}, less than {duration_s:g} s"
        )
    wanted = start_ns + np.round(np.arange(count) * spacing_s * 1e9).astype(np.int64)
    poses, valid = interpolate_poses(times, trajectory.T_R_B[first], wanted, max_gap_ns=_MAX_GAP_NS)
    if not valid.all():
        when = (wanted[np.argmin(valid)] - start_ns) * 1e-9
        raise UserError(
            f"sessions.trajectory: {trajectory.source} has a gap of more than a second at "
            f"{when:.1f} s; give a shorter duration_s"
        )
    return poses


def _shift(placed: list[F64], first: SessionOptions, world: WorldOptions) -> F64:
    """Return by what (3,) poses are moved: bounding box to the middle, first pose to its height."""
    p = np.concatenate([poses[:, 4:] for poses in placed])
    middle = 0.5 * (p.min(axis=0) + p.max(axis=0))
    shift = np.array([first.room * world.room_size_m[0], 0.0, 0.0]) - middle
    shift[2] = first.height_m - placed[0][0, 6]
    return np.asarray(shift)
