"""Interpolation between stamped poses."""

from __future__ import annotations

import numpy as np
import pytest

from maplab_py.errors import EstimationError
from maplab_py.geometry import se3, so3
from maplab_py.geometry.interpolation import interpolate_poses, interpolate_vectors, slerp

START = 1403715273262142976


def screw(t: np.ndarray) -> np.ndarray:
    """Constant velocity and constant angular velocity: exact for slerp and linear."""
    q = so3.multiply(so3.exp([0.5, -1.0, 2.0]), so3.exp(t[:, None] * np.array([0.3, 0.1, -0.2])))
    return se3.make(q, np.array([1.0, 2.0, 3.0]) + t[:, None] * np.array([0.1, -0.5, 2.0]))


def test_uniform_motion_is_exact_between_uneven_stamps() -> None:
    rng = np.random.default_rng(0)
    times = START + np.cumsum(rng.integers(1, 10**9, 40))
    query = rng.integers(times[0], times[-1], 500)
    T, valid = interpolate_poses(times, screw((times - START) * 1e-9), query)
    assert valid.all()
    assert np.max(np.abs(se3.local(screw((query - START) * 1e-9), T))) < 1e-11


def test_stamps_give_their_poses() -> None:
    times = START + np.array([0, 5, 7, 100])
    poses = screw(np.array([0.0, 1.0, 4.0, 2.0]))
    T, valid = interpolate_poses(times, poses, times)
    assert valid.all()
    assert np.max(np.abs(se3.local(poses, T))) < 1e-14


def test_outside_the_span_is_flagged_with_the_end_pose() -> None:
    times, poses = np.array([10, 20]), screw(np.array([0.0, 1.0]))
    T, valid = interpolate_poses(times, poses, np.array([9, 10, 20, 21]))
    assert valid.tolist() == [False, True, True, False]
    assert np.allclose(T, poses[[0, 0, 1, 1]], atol=1e-15)


def test_gaps_can_be_refused() -> None:
    times = np.array([0, 10, 50, 60])
    poses = screw(times * 0.1)
    _, valid = interpolate_poses(times, poses, np.array([5, 10, 30, 50, 55]), max_gap_ns=10)
    assert valid.tolist() == [True, True, False, True, True]


def test_the_shorter_arc_is_taken() -> None:
    a, b = so3.exp([0.0, 0.0, 0.1]), so3.exp([0.0, 0.0, 0.3])
    assert np.allclose(slerp(a, -b, 0.5), so3.exp([0.0, 0.0, 0.2]), atol=1e-15)
    assert slerp(np.tile(a, (4, 1)), b, np.linspace(0, 1, 4)).shape == (4, 4)


def test_one_pose_and_no_query() -> None:
    T, valid = interpolate_poses([7], se3.identity(1), [6, 7, 8])
    assert valid.tolist() == [False, True, False]
    assert np.array_equal(T, se3.identity(3))
    assert interpolate_poses([7], se3.identity(1), np.zeros(0, dtype=int))[0].shape == (0, 7)


def test_vectors_of_any_shape() -> None:
    values = np.arange(12.0).reshape(3, 2, 2)
    out, valid = interpolate_vectors([0, 10, 20], values, [5, 20, 30])
    assert valid.tolist() == [True, True, False]
    assert np.allclose(out[0], values[:2].mean(axis=0))
    assert np.array_equal(out[2], values[2])


@pytest.mark.parametrize("times", [[], [1, 1], [2, 1]])
def test_stamps_must_increase(times: list[int]) -> None:
    with pytest.raises(EstimationError, match="cannot interpolate"):
        interpolate_poses(np.array(times, dtype=np.int64), se3.identity(len(times)), [1])
