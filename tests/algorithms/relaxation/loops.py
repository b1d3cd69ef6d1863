"""Maps of a device that walks the same loop twice, drifts, and finds closures, some of them false."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.geometry import se3, so3
from maplab_py.vimap import BaseFrames, LoopClosureEdges, Missions, Vertices, VIMap, random_ids

F64 = NDArray[np.float64]
SIGMA_M, SIGMA_DEG = 0.03, 0.5


@dataclasses.dataclass(frozen=True)
class Loop:
    """A drifting map, its truth, and closures: the true ones come first."""

    vi_map: VIMap
    T_G_I: F64
    closures: LoopClosureEdges
    num_true: int


def simulate(seed: int, *, false_share: float = 0.3, missions: int = 1, drift: float = 1.0) -> Loop:
    """Make two laps of a figure of eight, 600 vertices, 180 s, 80 true closures."""
    rng = np.random.default_rng(seed)
    count, per_lap, step_s = 600, 300, 0.3
    s = np.arange(count) / count * 4.0 * np.pi
    p = np.stack([15.0 * np.cos(s), 8.0 * np.sin(2.0 * s), 0.5 * np.sin(3.0 * s)], axis=1)
    yaw = np.unwrap(np.arctan2(np.gradient(p[:, 1]), np.gradient(p[:, 0])))
    heading = so3.exp(yaw[:, None] * [0.0, 0.0, 1.0])
    truth = se3.make(so3.multiply(heading, so3.exp(0.05 * rng.normal(size=(count, 3)))), p)
    drifted = _drift(truth, step_s, drift, rng)
    mission = np.repeat(np.arange(missions), count // missions)
    first = np.flatnonzero(np.diff(mission, prepend=-1))
    for begin in first[1:]:  # every mission starts where it was, as after anchoring
        end = begin + count // missions
        T_new_old = se3.compose(truth[begin], se3.inverse(drifted[begin]))
        drifted[begin:end] = se3.compose(T_new_old, drifted[begin:end])
    closures = _closures(truth, per_lap, false_share, rng)
    vertices = Vertices.filled(
        count,
        id=random_ids(count, rng),
        mission=mission,
        T_M_I=drifted,
        v_M=so3.rotate(drifted[:, :4], [1.0, 0.0, 0.0]),
        timestamp_ns=(np.arange(count) * step_s * 1e9).astype(np.int64),
    )
    vi_map = VIMap(
        missions=Missions.filled(
            missions,
            id=random_ids(missions, rng),
            baseframe=np.arange(missions),
            root_vertex=first,
        ),
        baseframes=BaseFrames.filled(
            missions, id=random_ids(missions, rng), is_known=np.ones(missions, dtype=bool)
        ),
        vertices=vertices,
    )
    return Loop(vi_map, truth, closures, 80)


def _drift(truth: F64, step_s: float, drift: float, rng: np.random.Generator) -> F64:
    """Add random walks of heading and position and a scale error to a trajectory."""
    steps = len(truth) - 1
    relative = se3.relative(truth[:-1], truth[1:])
    distance = np.linalg.norm(relative[:, 4:], axis=1)
    up = so3.rotate(so3.inverse(truth[1:, :4]), [0.0, 0.0, 1.0])
    turn = drift * np.deg2rad(0.3) * np.sqrt(step_s) * rng.normal(size=(steps, 1))
    noise = drift * 0.02 * np.sqrt(distance)[:, None] * rng.normal(size=(steps, 3))
    q = so3.multiply(relative[:, :4], so3.exp(up * (turn + drift * np.deg2rad(0.02) * step_s)))
    relative = se3.make(q, relative[:, 4:] * (1.0 + 0.01 * drift) + noise)
    drifted = truth.copy()
    for step in range(steps):
        drifted[step + 1] = se3.compose(drifted[step], relative[step])
    return drifted


def _closures(
    truth: F64, per_lap: int, false_share: float, rng: np.random.Generator
) -> LoopClosureEdges:
    second = rng.choice(np.arange(per_lap, len(truth)), 80, replace=False)
    first = np.clip(second - per_lap + rng.integers(-2, 3, 80), 0, None)
    sigma = np.repeat([SIGMA_M, np.deg2rad(SIGMA_DEG)], 3)
    true = se3.relative(truth[first], truth[second])
    noise = rng.normal(size=(80, 6)) * sigma
    true = se3.make(so3.multiply(true[:, :4], so3.exp(noise[:, 3:])), true[:, 4:] + noise[:, :3])
    num_false = round(80 * false_share / (1.0 - false_share))
    a, b = rng.integers(0, len(truth), (2, num_false))
    b = np.where(np.abs(a - b) < 20, (a + per_lap // 2) % len(truth), b)
    turn = rng.normal(size=(num_false, 3)) * [0.05, 0.05, 1.0]
    false = se3.make(so3.exp(turn), rng.normal(size=(num_false, 3)))
    return LoopClosureEdges.filled(
        80 + num_false,
        id=random_ids(80 + num_false, rng),
        from_vertex=np.concatenate([first, a]),
        to_vertex=np.concatenate([second, b]),
        T_A_B=np.concatenate([true, false]),
        covariance=np.tile(np.diag(sigma**2), (80 + num_false, 1, 1)),
    )


def ate(T: F64, truth: F64) -> float:
    """Root mean square position error after alignment (SE(3)) [m]."""
    a, b = T[:, 4:] - T[:, 4:].mean(axis=0), truth[:, 4:] - truth[:, 4:].mean(axis=0)
    U, _, Vt = np.linalg.svd(b.T @ a)
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return float(np.sqrt(np.mean(np.sum((b - a @ R.T) ** 2, axis=1))))
