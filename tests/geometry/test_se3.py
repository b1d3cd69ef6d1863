"""Poses: group, exponential, Jacobians, interpolation."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplab_py.errors import EstimationError
from maplab_py.geometry import se3, so3
from maplab_py.geometry.interpolation import interpolate_poses, interpolate_vectors, slerp

tangents = st.lists(st.floats(-3.0, 3.0), min_size=6, max_size=6).map(np.array)
SHAPES = [(), (1,), (5,), (2, 3), (0,)]


def pose(tangent: np.ndarray) -> np.ndarray:
    return se3.retract(se3.identity(), tangent)


@given(tangents, tangents, tangents)
def test_group_axioms(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> None:
    a, b, c = pose(x), pose(y), pose(z)
    left = se3.compose(se3.compose(a, b), c)
    assert np.allclose(se3.local(left, se3.compose(a, se3.compose(b, c))), 0.0, atol=1e-12)
    assert np.allclose(se3.local(se3.compose(a, se3.inverse(a)), se3.identity()), 0.0, atol=1e-13)
    assert np.allclose(se3.compose(se3.identity(), a), a, atol=1e-15)
    assert np.allclose(se3.compose(a, se3.relative(a, b)), b, atol=1e-12) or np.allclose(
        se3.local(se3.compose(a, se3.relative(a, b)), b), 0.0, atol=1e-12
    )


@given(tangents, tangents)
def test_matrices_are_a_homomorphism(x: np.ndarray, y: np.ndarray) -> None:
    a, b = pose(x), pose(y)
    product = se3.to_matrix(a) @ se3.to_matrix(b)
    assert np.allclose(se3.to_matrix(se3.compose(a, b)), product, atol=1e-13)
    assert np.allclose(se3.local(se3.from_matrix(product), se3.compose(a, b)), 0.0, atol=1e-13)
    p = y[:3]
    assert np.allclose(se3.transform(a, p), (se3.to_matrix(a) @ [*p, 1.0])[:3], atol=1e-13)


@given(tangents, tangents)
def test_local_inverts_retract(x: np.ndarray, delta: np.ndarray) -> None:
    a = pose(x)
    angle = np.linalg.norm(delta[3:])
    if angle > 3.0:
        delta = delta * np.array([1, 1, 1, *[3.0 / angle] * 3])
    assert np.allclose(se3.local(a, se3.retract(a, delta)), delta, atol=1e-12)


def test_perturbation_is_on_the_right_and_position_in_the_outer_frame() -> None:
    a = se3.make(so3.exp([0.0, 0.0, np.pi / 2]), [1.0, 2.0, 3.0])
    moved = se3.retract(a, [1.0, 0.0, 0.0, 0.1, 0.0, 0.0])
    assert moved[4:] == pytest.approx([2.0, 2.0, 3.0])
    expected = so3.multiply(a[:4], so3.exp([0.1, 0.0, 0.0]))
    assert moved[:4] == pytest.approx(expected)


@pytest.mark.parametrize("shape", SHAPES)
def test_batch_shapes(shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(0)
    T = se3.make(so3.exp(rng.normal(size=(*shape, 3))), rng.normal(size=(*shape, 3)))
    assert T.shape == (*shape, 7)
    one = se3.identity()
    assert se3.compose(T, one).shape == se3.compose(one, T).shape == T.shape
    assert se3.inverse(T).shape == se3.relative(T, one).shape == T.shape
    assert se3.transform(T, np.zeros(3)).shape == (*shape, 3)
    assert se3.local(one, T).shape == (*shape, 6)
    assert se3.from_matrix(se3.to_matrix(T)).shape == T.shape
    assert se3.identity(*shape).shape == T.shape


screws = st.one_of(
    tangents.map(lambda d: d * np.array([1, 1, 1, 0.55, 0.55, 0.55])),
    st.sampled_from([0.0, 1e-300, 1e-12, 0.99e-4, 1.01e-4, 1e-3, np.pi - 1e-7]).map(
        lambda angle: np.array([1.0, -2.0, 3.0, 0.6 * angle, 0.0, 0.8 * angle])
    ),
)


@given(screws)
def test_log_inverts_exp(d: np.ndarray) -> None:
    assert np.allclose(se3.log(se3.exp(d)), d, atol=1e-11)


@given(screws)
def test_exp_is_a_one_parameter_group(d: np.ndarray) -> None:
    part, whole = se3.exp(d / 64), se3.identity()
    for _ in range(64):
        whole = se3.compose(whole, part)
    assert np.allclose(se3.local(se3.exp(d), whole), 0.0, atol=1e-12)
    assert np.allclose(se3.local(se3.exp(-d), se3.inverse(se3.exp(d))), 0.0, atol=1e-12)


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
