"""Motion of a session: smoothly joined pieces along paths or from the current pose."""

import dataclasses
from collections.abc import Callable

import numpy as np

from maplab_py.array_types import F64
from maplab_py.errors import UserError
from maplab_py.geometry import se3, so3
from maplab_py.simulation import detection, trajectory_motion
from maplab_py.simulation.scenario import PATH_KINDS, MotionOptions, SessionOptions, WorldOptions
from maplab_py.simulation.spline import PoseSpline
from maplab_py.simulation.world import World, stair_half_length, street_route

CONTROL_SPACING_S = 0.1

_SHAKES = 3
"""Number of sinusoids per axis of the shaking of a hand."""
_RAMP_S = 1.0
"""Acceleration time of pieces of a composed motion, which start and end at rest."""
_SETTLE_S = 0.5
"""Fade-in and fade-out time of shaking at the ends of a piece."""
_BRIDGE_SPEED_MPS = 0.8
_BRIDGE_RATE_RADPS = 0.8
_HOVER_HZ = 0.15
_BODY_RADIUS_M = 0.05


@dataclasses.dataclass(frozen=True, eq=False)
class _Entry:
    """Start of a piece of motion: the level pose at the end of the previous piece."""

    position: F64  # (3,)
    yaw: float
    turns: dict[str, float]  # parameter at which each path ended [turns]
    is_first: bool


def motion_spline(
    options: SessionOptions,
    world: WorldOptions,
    rng: np.random.Generator,
    together: tuple[SessionOptions, ...] = (),
) -> PoseSpline:
    """Return the motion of one session.

    Args:
        options: One piece of motion, several of them, or a trajectory file.
        world: Determines the size of the paths.
        rng: Source of start phase and shaking.
        together: Sessions whose trajectories share a frame with this one's.

    Raises:
        UserError: The trajectory file cannot be used.
    """
    if options.trajectory:
        return trajectory_motion.trajectory_spline(options, world, together)
    total = options.total_s
    count = int(np.ceil(total / CONTROL_SPACING_S)) + 4
    time: F64 = (np.arange(count, dtype=np.float64) - 1.0) * CONTROL_SPACING_S
    entry = _first_entry(options.phases or (options,), world)
    if not options.phases:
        poses, _ = _piece(options, world, entry, time, rng, is_alone=True)
        return PoseSpline(poses, CONTROL_SPACING_S)
    begin, parts = 0.0, []
    for number, phase in enumerate(options.phases):
        end = begin + phase.duration_s
        first = -np.inf if number == 0 else begin
        last = np.inf if number + 1 == len(options.phases) else end
        in_phase = (time >= first) & (time < last)
        poses, entry = _piece(phase, world, entry, time[in_phase] - begin, rng, is_alone=False)
        parts.append(poses)
        begin = end
    return PoseSpline(np.concatenate(parts), CONTROL_SPACING_S)


def check_free_way(spline: PoseSpline, world: World, key: str) -> None:
    """Check that a motion stays inside the world and does not cross walls.

    Raises:
        UserError: The check fails; the message starts with `key`.
    """
    way = spline.control[:, 4:]
    low, high = world.bounds
    outside = np.any((way < low + _BODY_RADIUS_M) | (way > high - _BODY_RADIUS_M), axis=1)
    blocked = np.append(detection.is_hidden(world.boxes, way[:-1], way[1:]), False)
    inside = np.zeros(len(way), dtype=np.bool_)
    for box in world.boxes:
        inside |= np.all((way > box[0]) & (way < box[1]), axis=1)
    wrong = outside | blocked | inside
    if np.any(wrong):
        row = int(np.flatnonzero(wrong)[0])
        place = ", ".join(f"{value:.1f}" for value in way[row])
        what = "out of the world" if outside[row] else "through a wall or furniture"
        when = max(row - 1, 0) * spline.spacing_s
        raise UserError(
            f"{key}: the motion leads {what} at {when:.1f} s, ({place}) m; change kind, "
            "wall_distance_m, height_m, duration_s or speed_mps"
        )


def _piece(
    motion: MotionOptions,
    world: WorldOptions,
    entry: _Entry,
    time: F64,
    rng: np.random.Generator,
    *,
    is_alone: bool,
) -> tuple[F64, _Entry]:
    """Return the poses (N, 7) of one piece at times since its begin, and where it ends."""
    jitter = rng.uniform(-0.02, 0.02)
    duration = motion.duration_s
    # the last time is the end of the piece
    at = np.append(time, duration)
    progress = at / duration if is_alone else _ease(at, duration)
    turns = dict(entry.turns)
    if motion.kind in PATH_KINDS:
        position, yaw, turns[motion.kind] = _path_piece(motion, world, entry, progress, jitter)
        if not entry.is_first:
            position, yaw = _bridge(entry, position, yaw, at)
    else:
        position, yaw = _free_piece(motion, entry, progress)
    window = np.ones(len(at)) if is_alone else _window(at, duration)
    look = _nodding(motion, progress) * window[:, None]
    q = so3.multiply(so3.exp(_about_z(yaw)), so3.exp(look))
    shaken_p, shaken_q = _shaking(motion, at, rng)
    position = position + window[:, None] * shaken_p
    q = so3.multiply(q, so3.exp(window[:, None] * shaken_q))
    end = _Entry(position[-1], float(yaw[-1]), turns, is_first=False)
    return se3.make(so3.normalize(q), position)[:-1], end


def _path_piece(
    motion: MotionOptions, world: WorldOptions, entry: _Entry, progress: F64, jitter: float
) -> tuple[F64, F64, float]:
    """Return positions (N, 3) and yaw (N,) along a path, and the turn at its end."""
    known = entry.turns.get(motion.kind)
    start = motion.start_turn + (jitter if known is None else known)
    sign = -1.0 if motion.reverse else 1.0
    turn = 2.0 * np.pi * (start + sign * motion.turns * progress)
    position, yaw = follow(turn, motion, world)
    position[:, 2] += motion.height_m
    if motion.kind != "vehicle":
        position[:, 2] += motion.height_swing_m * np.sin(1.7 * turn + start)
        yaw = yaw + motion.look_around_rad * np.sin(2.3 * turn + 5.0 * start)
    return position, yaw, start + sign * motion.turns


def _free_piece(motion: MotionOptions, entry: _Entry, progress: F64) -> tuple[F64, F64]:
    """Return positions (N, 3) and yaw (N,) of a piece that starts at the current pose."""
    sign = -1.0 if motion.reverse else 1.0
    turned = 2.0 * np.pi * sign * motion.turns * progress if motion.kind == "rotation" else 0.0
    yaw = entry.yaw + turned + np.zeros_like(progress)
    way = sign * motion.speed_mps * motion.duration_s if motion.kind == "straight" else 0.0
    ahead = np.array([np.cos(entry.yaw), np.sin(entry.yaw), 0.0])
    return entry.position + way * progress[:, None] * ahead, yaw


def _nodding(motion: MotionOptions, progress: F64) -> F64:
    """Return roll and pitch (N, 3) of a rotation in place."""
    look = np.zeros((len(progress), 3))
    if motion.kind == "rotation":
        angle = 2.0 * np.pi * max(abs(motion.turns), 1.0) * progress
        look[:, 0] = motion.look_around_rad * np.sin(2.0 * angle)
        look[:, 1] = motion.look_around_rad * np.sin(3.0 * angle)
    return look


def _first_entry(pieces: tuple[MotionOptions, ...], world: WorldOptions) -> _Entry:
    """Return the initial pose: the start of the first path, if there is one.

    Otherwise it is the middle of the room, its wall for `straight`, or the first corridor.
    """
    for piece in pieces:
        if piece.kind in PATH_KINDS:
            turn = np.array([2.0 * np.pi * piece.start_turn])
            position, yaw = follow(turn, piece, world)
            position[:, 2] += piece.height_m
            return _Entry(position[0], float(yaw[0]), {}, is_first=True)
    motion, size = pieces[0], np.asarray(world.room_size_m)
    heading = 2.0 * np.pi * motion.start_turn
    xy = np.array([motion.room * size[0], 0.0])
    if world.layout == "corridor":
        xy = np.array([0.0, 0.5 * (world.corridor_width_m - size[1])])
    elif motion.kind == "straight":
        back = -1.0 if motion.reverse else 1.0
        reach = 0.5 * size[:2] - motion.wall_distance_m
        xy = xy - back * reach * np.array([np.cos(heading), np.sin(heading)])
    return _Entry(np.append(xy, motion.height_m), heading, {}, is_first=True)


def _bridge(entry: _Entry, position: F64, yaw: F64, time: F64) -> tuple[F64, F64]:
    """Blend from the entry pose to the path; return positions and yaw."""
    now = int(np.argmin(np.abs(time)))
    gap = float(np.linalg.norm(position[now] - entry.position))
    behind = entry.yaw - yaw[now]
    turn = behind - 2.0 * np.pi * np.round(behind / (2.0 * np.pi))
    yaw = yaw + (behind - turn)
    if gap < 1e-3 and abs(turn) < 1e-3:
        return position, yaw
    lasts = max(_RAMP_S, 2.0 * gap / _BRIDGE_SPEED_MPS, 2.0 * abs(turn) / _BRIDGE_RATE_RADPS)
    left = 1.0 - _level_rise(np.clip(time / lasts, 0.0, 1.0))
    back = entry.position - position
    return position + left[:, None] * back, yaw + left * (entry.yaw - yaw)


def _ease(time: F64, duration: float) -> F64:
    """Return progress 0 .. 1 at constant speed with smooth ramps from and to rest."""
    ramp = min(_RAMP_S, 0.5 * duration)
    t = np.clip(time, 0.0, duration)

    def ramped(s: F64) -> F64:
        # integral of the raised cosine (1 - cos(pi s / ramp)) / 2
        return 0.5 * s - 0.5 * ramp / np.pi * np.sin(np.pi * s / ramp)

    rest = duration - t
    way = np.where(t < ramp, ramped(np.minimum(t, ramp)), t - 0.5 * ramp)
    way = np.where(rest < ramp, duration - ramp - ramped(np.minimum(rest, ramp)), way)
    return np.asarray(way / (duration - ramp))


def _window(time: F64, duration: float) -> F64:
    """Return a weight that rises from 0 at the begin of a piece to 1 and falls to 0 at its end."""
    settle = min(_SETTLE_S, 0.5 * duration)
    return _level_rise(np.clip(time / settle, 0.0, 1.0)) * _level_rise(
        np.clip((duration - time) / settle, 0.0, 1.0)
    )


def _level_rise(s: F64) -> F64:
    """Return a rise from 0 to 1 whose first and second derivatives vanish at both ends."""
    return np.asarray(s**3 * (10.0 + s * (6.0 * s - 15.0)))


def _about_z(yaw: F64) -> F64:
    return np.stack([0.0 * yaw, 0.0 * yaw, yaw], axis=1)


def _shaking(motion: MotionOptions, time: F64, rng: np.random.Generator) -> tuple[F64, F64]:
    """Return hand shake as position (N, 3) and rotation vector (N, 3)."""
    hertz = _HOVER_HZ if motion.kind == "hover" else motion.shake_hz
    shake_p = _shake(time, motion.shake_m, hertz, rng)
    shake_q = _shake(time, motion.shake_rad, hertz, rng)
    if motion.kind in ("straight", "stationary", "vehicle"):
        return 0.0 * shake_p, 0.0 * shake_q
    return (0.0 * shake_p, 0.0 * shake_q) if motion.kind == "rotation" else (shake_p, shake_q)


def _shake(time: F64, amplitude: float, hertz: float, rng: np.random.Generator) -> F64:
    """Return a sum of sinusoids (N, 3) about a frequency, with random phases."""
    frequency = hertz * rng.uniform(0.4, 1.6, (_SHAKES, 3))
    phase = rng.uniform(0.0, 2.0 * np.pi, (_SHAKES, 3))
    waves = np.sin(2.0 * np.pi * frequency * time[:, None, None] + phase)
    return np.asarray(amplitude / np.sqrt(_SHAKES) * waves.sum(axis=1))


Path = Callable[[F64, MotionOptions, WorldOptions], tuple[F64, F64]]
"""Takes turns (N,) [rad]; returns positions (N, 3) above the height of the motion, and yaw (N,)."""

_POINTS_PER_TURN = 4096
_LANE_M = 0.4
"""Distance from the middle of a doorway, so that the paths in both directions differ."""
_DOOR_APPROACH_M = 1.5


def follow(turn: F64, motion: MotionOptions, world: WorldOptions) -> tuple[F64, F64]:
    """Return positions (N, 3) above the height of the motion and yaw (N,) after turns (N,) [rad].

    The yaw points in the direction of increasing `turn`; in reverse motion it is opposite except
    on room_scan.
    """
    position, yaw = _PATHS[motion.kind](turn, motion, world)
    if motion.reverse and motion.kind != "room_scan":
        yaw = yaw + np.pi
    return position, yaw


def _room_scan(turn: F64, motion: MotionOptions, world: WorldOptions) -> tuple[F64, F64]:
    """Walk along an ellipse and look at the walls."""
    half = _half_room(motion, world)
    xy = np.stack([half[0] * np.cos(turn), half[1] * np.sin(turn)], axis=1)
    return _in_room(xy, motion, world), np.unwrap(
        np.arctan2(xy[:, 1] / half[1], xy[:, 0] / half[0])
    )


def _figure_8(turn: F64, motion: MotionOptions, world: WorldOptions) -> tuple[F64, F64]:
    """Walk a lemniscate and look ahead."""
    half = _half_room(motion, world)
    xy = np.stack([half[0] * np.sin(turn), half[1] * np.sin(2.0 * turn)], axis=1)
    ahead = np.stack([half[0] * np.cos(turn), 2.0 * half[1] * np.cos(2.0 * turn)], axis=1)
    return _in_room(xy, motion, world), np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))


def _loop(turn: F64, motion: MotionOptions, world: WorldOptions) -> tuple[F64, F64]:
    """Walk along the walls of all rooms, through the doorways there and back, and look ahead."""
    size_x = world.room_size_m[0]
    half = _half_room(motion, world)
    half[0] += 0.5 * (world.rooms - 1) * size_x
    xy = _superellipse(half, 4)
    xy[:, 0] += 0.5 * (world.rooms - 1) * size_x
    narrow = min(_LANE_M / half[1], 1.0)
    wide_y = xy[:, 1].copy()
    for door in range(1, world.rooms):
        distance = xy[:, 0] - (door - 0.5) * size_x
        xy[:, 1] *= 1.0 - (1.0 - narrow) * np.exp(-((distance / _DOOR_APPROACH_M) ** 2))
    for room in world.corridor_rooms:
        inside = np.abs(xy[:, 0] - room * size_x) <= 0.5 * size_x
        xy[:, 1] = np.where(inside, narrow * wide_y, xy[:, 1])
    return _along(np.column_stack([xy, np.zeros(len(xy))]), turn)


def _corridor(turn: F64, _: MotionOptions, world: WorldOptions) -> tuple[F64, F64]:
    """Walk the corridors, floor by floor up and down again, and look ahead."""
    half = 0.5 * (np.asarray(world.room_size_m[:2]) - world.corridor_width_m)
    # begins in the middle of the side at -y, away from the stairs
    xy = np.roll(_superellipse(half, 8), _POINTS_PER_TURN // 4, axis=0)
    position, yaw = _along(np.column_stack([xy, np.zeros(len(xy))]), turn)
    if world.floors == 1:
        return position, yaw
    circuit = np.floor(turn / (2.0 * np.pi))
    within = turn / (2.0 * np.pi) - circuit
    step = np.mod(circuit, 2 * (world.floors - 1))
    upwards = step < world.floors - 1
    # up the stairs at +x in the first half of a circuit, down those at -x in the second
    stair = np.clip(position[:, 1] / stair_half_length(world), -1.0, 1.0)
    rise = np.where(within < 0.5, 0.5 + 0.5 * stair, 1.0)
    fall = np.where(within < 0.5, 0.0, 0.5 - 0.5 * stair)
    floor = np.where(upwards, step + _smooth(rise), 2 * (world.floors - 1) - step - _smooth(fall))
    position[:, 2] = floor * world.room_size_m[2]
    return position, yaw


def _streets(turn: F64, motion: MotionOptions, world: WorldOptions) -> tuple[F64, F64]:
    """Walk the streets round a rectangle of blocks and look ahead."""
    xy = street_route(world, motion.first_block, motion.last_block)
    return _along(np.column_stack([xy, np.zeros(len(xy))]), turn)


_PATHS: dict[str, Path] = {
    "room_scan": _room_scan,
    "figure_8": _figure_8,
    "loop": _loop,
    "vehicle": _loop,
    "corridor": _corridor,
    "streets": _streets,
}


def _half_room(motion: MotionOptions, world: WorldOptions) -> F64:
    return 0.5 * np.asarray(world.room_size_m[:2]) - motion.wall_distance_m


def _in_room(xy: F64, motion: MotionOptions, world: WorldOptions) -> F64:
    shift = motion.room * world.room_size_m[0]
    return np.column_stack([xy[:, 0] + shift, xy[:, 1], np.zeros(len(xy))])


def _superellipse(half: F64, power: int) -> F64:
    """Return one turn (4096, 2) of the curve |x / a|^n + |y / b|^n = 1, from +x towards +y."""
    angle = 2.0 * np.pi * np.arange(_POINTS_PER_TURN) / _POINTS_PER_TURN
    c, s = np.cos(angle), np.sin(angle)
    radius = (np.abs(c) ** power + np.abs(s) ** power) ** (-1.0 / power)
    return np.stack([half[0] * radius * c, half[1] * radius * s], axis=1)


def _along(curve: F64, turn: F64) -> tuple[F64, F64]:
    """Return positions (N, 3) and yaw (N,) at even speed along a closed curve (K, 3)."""
    closed = np.concatenate([curve, curve[:1]])
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    circuits = turn / (2.0 * np.pi)
    place = np.mod(circuits, 1.0) * length[-1]
    position = np.stack([np.interp(place, length, closed[:, k]) for k in range(3)], axis=1)
    ahead = np.roll(curve, -1, axis=0) - np.roll(curve, 1, axis=0)
    heading = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    round_trip = 2.0 * np.pi * np.round((heading[-1] - heading[0]) / (2.0 * np.pi))
    heading = np.concatenate([heading, heading[:1] + round_trip])
    return position, np.interp(place, length, heading) + round_trip * np.floor(circuits)


def _smooth(fraction: F64) -> F64:
    """Return a smooth step from 0 to 1 with zero slope at both ends."""
    return fraction**2 * (3.0 - 2.0 * fraction)
