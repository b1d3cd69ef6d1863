"""Motion along a recorded trajectory: a spline through its poses; the spline is the truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from maplab_py.errors import MapError, UserError
from maplab_py.geometry import se3, so3
from maplab_py.geometry.interpolation import interpolate_poses
from maplab_py.interop.trajectories import Trajectory, read_trajectory
from maplab_py.simulation.scenario import SessionOptions, WorldOptions
from maplab_py.simulation.spline import PoseSpline

F64 = NDArray[np.float64]

KNOT_SPACING_S = 0.1

_ROUNDS = 60
"""Each round leaves at most two thirds of what is missing at the knots: 60 leave 3e-11 of it."""
_MAX_GAP_NS = 1_000_000_000


def trajectory_spline(options: SessionOptions, world: WorldOptions) -> PoseSpline:
    """Return the spline through a trajectory file, set into the middle of the first room.

    The first `duration_s` seconds are used. The body begins at `height_m`, its heading is the
    file's. Control poses are those of the file every 0.1 s; between them the spline is smoother
    than the file.

    Raises:
        UserError: The file is no trajectory, is too short, or has gaps of more than a second.
    """
    path = Path(options.trajectory)
    try:
        trajectory = read_trajectory(path)
    except MapError as error:
        raise UserError(f"sessions.trajectory: {error}") from None
    poses = _placed(_resampled(trajectory, options.duration_s), options, world)
    return through(poses, KNOT_SPACING_S)


def through(poses: F64, spacing_s: float) -> PoseSpline:
    """Return the spline that passes through poses (N, 7) at multiples of `spacing_s` from 0.

    The control poses are found by repeated correction: what the spline misses at its knots is added
    to them. The value at a knot is 2/3 of its own control pose and 1/6 of each neighbour's, so every
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


def _resampled(trajectory: Trajectory, duration_s: float) -> F64:
    """Return the poses (N, 7) every 0.1 s from the begin of the file."""
    times, first = np.unique(trajectory.times_ns, return_index=True)
    seconds = min(duration_s + 2.0 * KNOT_SPACING_S, (times[-1] - times[0]) * 1e-9)
    count = int(seconds / KNOT_SPACING_S) + 1
    if seconds < duration_s or count < 4:
        raise UserError(
            f"sessions.duration_s: {trajectory.source} lasts {(times[-1] - times[0]) * 1e-9:.1f} s,"
            f" less than {duration_s:g} s"
        )
    wanted = times[0] + np.round(np.arange(count) * KNOT_SPACING_S * 1e9).astype(np.int64)
    poses, valid = interpolate_poses(times, trajectory.T_R_B[first], wanted, max_gap_ns=_MAX_GAP_NS)
    if not valid.all():
        when = (wanted[np.argmin(valid)] - times[0]) * 1e-9
        raise UserError(
            f"sessions.trajectory: {trajectory.source} has a gap of more than a second at "
            f"{when:.1f} s; give a shorter duration_s"
        )
    return poses


def _placed(poses: F64, options: SessionOptions, world: WorldOptions) -> F64:
    """Shift poses so that their bounding box is centred in the room and the first is at height."""
    middle = 0.5 * (poses[:, 4:].min(axis=0) + poses[:, 4:].max(axis=0))
    shift = np.array([options.room * world.room_size_m[0], 0.0, 0.0]) - middle
    shift[2] = options.height_m - poses[0, 6]
    moved = poses.copy()
    moved[:, 4:] += shift
    return moved
