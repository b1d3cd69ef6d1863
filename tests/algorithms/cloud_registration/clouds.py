"""Simulated clouds with true relative poses, and sessions with a lidar."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np

from maplab_py.array_types import F64
from maplab_py.geometry import se3, so3
from maplab_py.simulation.scenario import (
    DriftOptions,
    LidarOptions,
    MeasurementOptions,
    Scenario,
    SessionOptions,
    WorldOptions,
)
from maplab_py.simulation.simulate import Lidar
from maplab_py.simulation.truth import Truth
from maplab_py.simulation.world import World, make_world
from maplab_py.vimap import VIMap
from maplab_py.vimap.ids import IdIndex

ROOM = WorldOptions(landmarks_per_room=200)
LONG_CORRIDOR = WorldOptions(
    layout="corridor", room_size_m=(90.0, 70.0, 3.0), furniture_per_room=0, landmarks_per_room=200
)
CORRIDOR = dataclasses.replace(LONG_CORRIDOR, room_size_m=(16.0, 12.0, 3.0), landmarks_per_room=600)
_APART_M = 3.0


@dataclasses.dataclass(frozen=True, eq=False)
class Pair:
    """Two clouds, the true pose of the source in the target, and an initial one that is off."""

    target: F64  # (N, 3)
    source: F64  # (M, 3)
    T_T_S: F64  # (7,)
    start: F64  # (7,)


def pairs(options: WorldOptions, count: int, seed: int = 0) -> Iterator[Pair]:
    """Yield pairs of up to 3 m distance, with starts off by 0.5 m and 10 deg."""
    rng = np.random.default_rng(seed)
    world = make_world(options, rng)
    lidar = Lidar.of(world, LidarOptions(rate_hz=1.0), rng)
    for _ in range(count):
        a = _free_position(world, rng)
        b = _free_position(world, rng)
        while np.linalg.norm(a - b) > _APART_M:
            a, b = _free_position(world, rng), _free_position(world, rng)
        poses = [_pose(p, rng) for p in (a, b)]
        T_T_S = se3.relative(*poses)
        error = se3.make(so3.exp(_of_length(np.deg2rad(10.0), rng)), _of_length(0.5, rng))
        clouds = [lidar.scan(pose, rng).p for pose in poses]
        yield Pair(clouds[0], clouds[1], T_T_S, se3.compose(T_T_S, error))


def _free_position(world: World, rng: np.random.Generator) -> F64:
    low, high = world.bounds
    while True:
        p = rng.uniform(low + 0.8, high - 0.8)
        p[2] = rng.uniform(1.0, 2.0)
        inside = (p > world.boxes[:, 0] - 0.3) & (p < world.boxes[:, 1] + 0.3)
        if not inside.all(axis=1).any():
            return p


def _pose(p: F64, rng: np.random.Generator) -> F64:
    tilt = rng.normal(0.0, 0.03, 2)
    return se3.make(so3.exp([*tilt, rng.uniform(-np.pi, np.pi)]), p)


def _of_length(length: float, rng: np.random.Generator) -> F64:
    v = rng.normal(size=3)
    return v * (length / np.linalg.norm(v))


def errors(T_A_B: F64, estimate: F64) -> tuple[float, float]:
    """Return the distance [m] and the angle [deg] between two poses (7,)."""
    e = se3.local(T_A_B, estimate)
    return float(np.linalg.norm(e[:3])), float(np.degrees(np.linalg.norm(e[3:])))


def session(
    world: WorldOptions, motion: SessionOptions, *, rate_hz: float, seed: int = 1
) -> Scenario:
    """Return a drifting session with a lidar and few landmarks."""
    return Scenario(
        world=world,
        sessions=(motion,),
        lidar=LidarOptions(rate_hz=rate_hz),
        measurement=MeasurementOptions(max_keypoints=30),
        drift=DriftOptions(yaw_walk_deg=0.5, position_walk=0.03),
    ).with_seed(seed)


def edge_errors(vi_map: VIMap, truth: Truth) -> tuple[F64, F64]:
    """Return the errors [m, deg] of the loop closure edges (E,) of a map."""
    edges = vi_map.loop_closure_edges
    T_G_I = truth.T_G_I[IdIndex(truth.vertex_id).rows(vi_map.vertices.id)]
    T_A_B = se3.relative(T_G_I[edges.from_vertex], T_G_I[edges.to_vertex])
    e = se3.local(T_A_B, edges.T_A_B)
    return np.linalg.norm(e[:, :3], axis=1), np.degrees(np.linalg.norm(e[:, 3:], axis=1))
