"""The chain of inertial edges: joining, predicting, integrating again."""

import numpy as np
import pytest

from maplab_py.array_types import F64, I64
from maplab_py.errors import MapError
from maplab_py.estimation.codegen.kernels import residual_kernel
from maplab_py.estimation.symbolic import sources
from maplab_py.estimation.window.frame import ImuPart
from maplab_py.estimation.window.inertial import InertialChain
from maplab_py.estimation.window.states import WindowStates
from maplab_py.sensors import Imu

POSE = np.array([0.1, -0.2, 0.3, 0.9, 1.0, 2.0, 3.0]) / np.array([*[np.sqrt(0.95)] * 4, 1, 1, 1])
MOTION = np.array([0.5, -0.3, 0.2, 0.01, -0.02, 0.005, 0.1, -0.05, 0.08])


def samples(seed: int = 1, count: int = 41) -> tuple[I64, F64]:
    rng = np.random.default_rng(seed)
    values = np.array([0.0, 0.0, 9.81, 0.1, 0.0, -0.2]) + rng.normal(0.0, 0.5, (count, 6))
    return 1_600_000_000_000_000_000 + 5_000_000 * np.arange(count), values


@pytest.fixture
def chain() -> InertialChain:
    return InertialChain(residual_kernel("inertial", sources.inertial), Imu("a" * 32))


@pytest.mark.parametrize("cut", [1, 7, 20, 39])
def test_joined_intervals_are_as_if_never_split(chain: InertialChain, cut: int) -> None:
    times_ns, values = samples()
    chain.append(times_ns, values, MOTION, is_resting=True)
    pose, later = chain.predict(POSE, MOTION)
    states = np.array([POSE, pose]), np.array([MOTION, later])
    whole = chain.evaluate(*states, slice(None))
    chain.drop_last()
    assert len(chain) == 0
    chain.append(times_ns[: cut + 1], values[: cut + 1], MOTION, is_resting=True)
    chain.append(times_ns[cut:], values[cut:], MOTION + 0.01, is_resting=False)
    chain.join(1, MOTION)
    assert len(chain) == 1
    assert not chain.is_resting[0]
    for joined, expected in zip(chain.evaluate(*states, slice(None)), whole, strict=True):
        np.testing.assert_array_equal(joined, expected)
    np.testing.assert_array_equal(chain.predict(POSE, MOTION)[0], pose)


def test_edges_together_are_as_if_added_one_by_one(chain: InertialChain) -> None:
    several = InertialChain(residual_kernel("inertial", sources.inertial), Imu("a" * 32))
    motion = MOTION + 0.01 * np.arange(3)[:, None]
    edges = [samples(seed, count) for seed, count in ((1, 41), (2, 11), (3, 21))]
    several.extend(edges, motion)
    for edge, at in zip(edges, motion, strict=True):
        chain.append(*edge, at, is_resting=False)
    states = np.tile(POSE, (4, 1)), np.tile(MOTION, (4, 1))
    results = (each.evaluate(*states, slice(None)) for each in (chain, several))
    for alone, together in zip(*results, strict=True):
        np.testing.assert_array_equal(together, alone)
    bad = [samples(1), (samples(2)[0][::-1], samples(2)[1])]
    with pytest.raises(MapError):
        several.extend(bad, motion[:2])
    assert len(several) == 3


def test_prediction_has_no_residual(chain: InertialChain) -> None:
    chain.append(*samples(), MOTION, is_resting=False)
    pose, motion = chain.predict(POSE, MOTION)
    residual, _ = chain.evaluate(np.array([POSE, pose]), np.array([MOTION, motion]), slice(None))
    np.testing.assert_allclose(residual, 0.0, atol=1e-6)


def test_jacobian_columns_are_the_rows_of_the_system(chain: InertialChain) -> None:
    chain.append(*samples(1), MOTION, is_resting=False)
    chain.append(*samples(2), MOTION, is_resting=False)
    T_M_I = np.tile(POSE, (3, 1))
    states = WindowStates(T_M_I, np.tile(MOTION, (3, 1)), np.zeros((0, 3)))
    _, jacobian = chain.evaluate(states.T_M_I, states.motion, slice(1, 2))
    numeric, step = np.empty((9, 45)), 1e-6
    for column in range(45):
        move = np.zeros(45)
        move[column] = step
        ends = [states.moved(sign * move, states.h) for sign in (1.0, -1.0)]
        ahead, behind = (chain.evaluate(s.T_M_I, s.motion, slice(1, 2))[0][0] for s in ends)
        numeric[:, column] = (ahead - behind) / (2.0 * step)
    scale = np.abs(jacobian).max()
    np.testing.assert_allclose(jacobian[0], numeric[:, 15:39], atol=1e-6 * scale)
    np.testing.assert_allclose(numeric[:, :15], 0.0, atol=1e-6 * scale)


def test_integrates_again_where_biases_moved(chain: InertialChain) -> None:
    for seed in (1, 2):
        chain.append(*samples(seed), MOTION, is_resting=False)
    motion = np.tile(MOTION, (3, 1))
    assert not chain.relinearize(motion)
    motion[1, 3:6] += 0.01
    T_M_I = np.tile(POSE, (3, 1))
    before, _ = chain.evaluate(T_M_I, motion, slice(None))
    assert chain.relinearize(motion)
    after, _ = chain.evaluate(T_M_I, motion, slice(None))
    np.testing.assert_array_equal(before[0], after[0])
    assert np.abs(before[1] - after[1]).max() > 0.0
    fresh = InertialChain(residual_kernel("inertial", sources.inertial), Imu("a" * 32))
    fresh.append(*samples(1), motion[0], is_resting=False)
    fresh.append(*samples(2), motion[1], is_resting=False)
    np.testing.assert_array_equal(fresh.evaluate(T_M_I, motion, slice(None))[0], after)


def test_a_doubt_leaves_the_states_as_they_are(chain: InertialChain) -> None:
    chain.append(*samples(), MOTION, is_resting=False)
    motion = np.tile(MOTION, (2, 1))
    motion[0, 3] += 1e-6  # too little to integrate again
    before = motion.copy()
    assert not chain.relinearize(motion)
    chain.doubt(0, ImuPart.GYROSCOPE)
    chain.relinearize(before)
    np.testing.assert_array_equal(motion, before)
