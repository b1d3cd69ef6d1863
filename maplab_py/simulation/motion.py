"""Generators of motion: a person or a small vehicle that carries the sensors through a room."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from maplab_py.geometry import se3, so3
from maplab_py.simulation.scenario import MotionOptions
from maplab_py.simulation.spline import PoseSpline

F64 = NDArray[np.float64]

CONTROL_SPACING_S = 0.1

_SHAKES = 3
"""Sinusoids per axis that make up the shaking of a hand."""

PathOfTurn = Callable[[F64, F64], tuple[F64, F64]]


def motion_spline(options: MotionOptions, room_size_m: F64, rng: np.random.Generator) -> PoseSpline:
    """Return the motion of one session: a path with a heading, plus the shaking of a hand.

    Args:
        options: Kind, duration, direction, height and amplitudes.
        room_size_m: Length, width and height (3,) of the space that is walked through.
        rng: Source of start phase and shaking.
    """
    count = int(np.ceil(options.duration_s / CONTROL_SPACING_S)) + 4
    time: F64 = (np.arange(count, dtype=np.float64) - 1.0) * CONTROL_SPACING_S
    start = options.start_turn + rng.uniform(-0.02, 0.02)
    sign = -1.0 if options.reverse else 1.0
    turn = 2.0 * np.pi * (start + sign * options.turns * time / options.duration_s)
    half = 0.5 * room_size_m[:2] - options.wall_distance_m
    xy, yaw = _PATHS[options.kind](turn, half)
    if options.kind != "room_scan":
        yaw = yaw + (np.pi if options.reverse else 0.0)
    height = options.height_m + options.height_swing_m * np.sin(1.7 * turn + start)
    position = np.concatenate([xy, height[:, None]], axis=1)
    yaw = yaw + options.look_around_rad * np.sin(2.3 * turn + 5.0 * start)
    q = so3.exp(np.stack([0.0 * yaw, 0.0 * yaw, yaw], axis=1))
    position = position + _shake(time, options.shake_m, rng)
    q = so3.multiply(q, so3.exp(_shake(time, options.shake_rad, rng)))
    return PoseSpline(se3.make(so3.normalize(q), position), CONTROL_SPACING_S)


def _room_scan(turn: F64, half: F64) -> tuple[F64, F64]:
    """Walk along an ellipse and look at the walls."""
    xy = np.stack([half[0] * np.cos(turn), half[1] * np.sin(turn)], axis=1)
    return xy, np.unwrap(np.arctan2(xy[:, 1] / half[1], xy[:, 0] / half[0]))


def _figure_8(turn: F64, half: F64) -> tuple[F64, F64]:
    """Walk a lemniscate and look ahead."""
    xy = np.stack([half[0] * np.sin(turn), half[1] * np.sin(2.0 * turn)], axis=1)
    ahead = np.stack([half[0] * np.cos(turn), 2.0 * half[1] * np.cos(2.0 * turn)], axis=1)
    return xy, np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))


def _loop(turn: F64, half: F64) -> tuple[F64, F64]:
    """Walk a rounded rectangle along the walls and look ahead."""
    # the superellipse |x|^4 + |y|^4 = 1
    c, s = np.cos(turn), np.sin(turn)
    radius = (c**4 + s**4) ** -0.25
    xy = np.stack([half[0] * radius * c, half[1] * radius * s], axis=1)
    ahead = np.gradient(xy, axis=0) * np.sign(turn[-1] - turn[0])
    return xy, np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))


_PATHS: dict[str, PathOfTurn] = {"room_scan": _room_scan, "figure_8": _figure_8, "loop": _loop}


def _shake(time: F64, amplitude: float, rng: np.random.Generator) -> F64:
    """Return a sum of sinusoids (N, 3) between 0.4 and 1.6 Hz with random phases."""
    frequency = rng.uniform(0.4, 1.6, (_SHAKES, 3))
    phase = rng.uniform(0.0, 2.0 * np.pi, (_SHAKES, 3))
    waves = np.sin(2.0 * np.pi * frequency * time[:, None, None] + phase)
    return np.asarray(amplitude / np.sqrt(_SHAKES) * waves.sum(axis=1))
