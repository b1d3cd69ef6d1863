"""Alignment of positions, alone and about the vertical."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplab_py.errors import EstimationError
from maplab_py.geometry import se3, so3, yaw
from maplab_py.geometry.alignment import align_yaw_position, apply_similarity, umeyama


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(11)


def random_pose(rng: np.random.Generator) -> np.ndarray:
    return se3.make(so3.exp(rng.normal(size=3) * 2), rng.normal(size=3) * 10)


@pytest.mark.parametrize("count", [3, 4, 100])
@pytest.mark.parametrize("scale", [1.0, 0.01, 37.0])
def test_exact_motions_come_back(rng: np.random.Generator, count: int, scale: float) -> None:
    T, p = random_pose(rng), rng.normal(size=(count, 3))
    found, s = umeyama(se3.transform(T, scale * p), p, with_scale=True)
    assert s == pytest.approx(scale, rel=1e-12)
    assert np.max(np.abs(se3.local(T, found))) < 1e-11
    if scale == 1.0:
        found, s = umeyama(se3.transform(T, p), p)
        assert s == 1.0
        assert np.max(np.abs(se3.local(T, found))) < 1e-12


def test_planar_points_and_reflections_give_rotations(rng: np.random.Generator) -> None:
    p = rng.normal(size=(20, 3)) * [1, 1, 0]
    T = random_pose(rng)
    found, _ = umeyama(se3.transform(T, p), p)
    assert np.max(np.abs(se3.local(T, found))) < 1e-12
    mirrored, _ = umeyama(
        rng.normal(size=(20, 3)) * [1, 2, 3] * [-1, 1, 1], rng.normal(size=(20, 3))
    )
    assert np.linalg.det(se3.to_matrix(mirrored)[:3, :3]) == pytest.approx(1.0)


@pytest.mark.parametrize("with_scale", [True, False])
def test_no_small_change_is_better(rng: np.random.Generator, with_scale: bool) -> None:
    p_B = rng.normal(size=(30, 3))
    p_A = se3.transform(random_pose(rng), 1.3 * p_B) + rng.normal(size=(30, 3)) * 0.2
    T, scale = umeyama(p_A, p_B, with_scale=with_scale)

    def cost(T: np.ndarray, scale: float) -> float:
        return float(np.sum((p_A - se3.transform(T, scale * p_B)) ** 2))

    best = cost(T, scale)
    for delta in np.concatenate([np.eye(6), -np.eye(6)]) * 1e-4:
        assert cost(se3.retract(T, delta), scale) > best
    if with_scale:
        assert min(cost(T, scale * 1.0001), cost(T, scale * 0.9999)) > best


def test_yaw_and_position(rng: np.random.Generator) -> None:
    T = np.array([4.0, -3.0, 2.0, 2.5])
    p = rng.normal(size=(10, 3))
    found = align_yaw_position(yaw.transform(T, p), p)
    assert np.allclose(yaw.from_pose(found), T, atol=1e-13)
    assert found[:2].tolist() == [0.0, 0.0]
    p_A = yaw.transform(T, p) + rng.normal(size=(10, 3)) * 0.3
    best = yaw.from_pose(align_yaw_position(p_A, p))
    cost = np.sum((p_A - yaw.transform(best, p)) ** 2)
    for delta in np.concatenate([np.eye(4), -np.eye(4)]) * 1e-4:
        assert np.sum((p_A - yaw.transform(best + delta, p)) ** 2) > cost


def test_two_points_are_enough_for_yaw() -> None:
    T = np.array([1.0, 2.0, 3.0, -1.0])
    p = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    found = align_yaw_position(yaw.transform(T, p), p)
    assert np.allclose(yaw.from_pose(found), T)


LINE = np.arange(5.0)[:, None] * np.array([1.0, 2.0, 3.0]) + [1e3, 0, 0]


@pytest.mark.parametrize(
    ("p_A", "p_B", "message"),
    [
        (np.zeros((2, 3)), np.zeros((2, 3)), "at least 3 are needed"),
        (LINE, LINE, "on one line"),
        (np.ones((5, 3)), np.ones((5, 3)), "on one line"),
        (np.zeros((4, 3)), np.zeros((5, 3)), "shapes"),
        (np.zeros((4, 2)), np.zeros((4, 2)), "shapes"),
        (np.full((4, 3), np.nan), np.zeros((4, 3)), "not finite"),
    ],
)
def test_umeyama_refuses_what_it_cannot_solve(p_A, p_B, message: str) -> None:
    for with_scale in (True, False):
        with pytest.raises(EstimationError, match=message):
            umeyama(p_A, p_B, with_scale=with_scale)


@pytest.mark.parametrize(
    ("p", "message"),
    [
        (np.zeros((1, 3)), "at least 2"),
        (np.arange(5.0)[:, None] * [0.0, 0.0, 1.0], "no horizontal extent"),
        (np.ones((5, 3)), "no horizontal extent"),
        (np.full((4, 3), np.inf), "not finite"),
    ],
)
def test_yaw_alignment_refuses_what_it_cannot_solve(p: np.ndarray, message: str) -> None:
    with pytest.raises(EstimationError, match=message):
        align_yaw_position(p, p)


def test_apply_similarity_scales_positions_only(rng: np.random.Generator) -> None:
    T_A_B, T_B_C = random_pose(rng), np.stack([random_pose(rng), random_pose(rng)])
    result = apply_similarity(T_A_B, 2.0, T_B_C)
    assert np.allclose(result[:, 4:], se3.transform(T_A_B, 2.0 * T_B_C[:, 4:]))
    assert np.allclose(result[:, :4], se3.compose(T_A_B, T_B_C)[:, :4])


elements = st.tuples(
    *(st.floats(-5.0, 5.0) for _ in range(3)), st.floats(-np.pi + 1e-9, np.pi - 1e-9)
).map(np.array)
IDENTITY = np.zeros(4)


def near(a: np.ndarray, b: np.ndarray, tolerance: float = 1e-12) -> bool:
    apart = np.concatenate([b[:3] - a[:3], yaw.wrap(b[3:] - a[3:])])
    return bool(np.max(np.abs(apart)) < tolerance)


@given(elements, elements, elements)
def test_group_axioms(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> None:
    left = yaw.compose(yaw.compose(a, b), c)
    assert near(left, yaw.compose(a, yaw.compose(b, c)))
    assert near(yaw.compose(a, yaw.inverse(a)), IDENTITY)
    assert near(yaw.compose(yaw.inverse(a), a), IDENTITY)
    assert near(yaw.compose(a, IDENTITY), a)


@given(elements, elements)
def test_poses_are_a_subgroup(a: np.ndarray, b: np.ndarray) -> None:
    composed = se3.compose(yaw.to_pose(a), yaw.to_pose(b))
    assert near(yaw.from_pose(composed), yaw.compose(a, b))
    p = b[:3]
    assert np.allclose(yaw.transform(a, p), se3.transform(yaw.to_pose(a), p), atol=1e-13)


def test_yaw_is_that_of_the_nearest_rotation_about_z() -> None:
    rng = np.random.default_rng(3)
    q = so3.exp(rng.normal(size=(20, 3)))
    candidates = np.linspace(-np.pi, np.pi, 20001)
    R = so3.to_matrix(yaw.quaternion(candidates))
    for one in q:
        distance = np.sum((R - so3.to_matrix(one)) ** 2, axis=(1, 2))
        assert abs(yaw.wrap(candidates[np.argmin(distance)] - yaw.yaw_of(one))) < 4e-4
    assert np.allclose(yaw.yaw_of(-q), yaw.yaw_of(q))


def test_angles_wrap() -> None:
    assert yaw.wrap(3 * np.pi / 2) == pytest.approx(-np.pi / 2)
    near_pi = np.array([0.0, 0.0, 0.0, 3.0])
    assert yaw.compose(near_pi, near_pi)[3] == pytest.approx(6.0 - 2 * np.pi)


@pytest.mark.parametrize("shape", [(), (1,), (4,), (2, 3), (0,)])
def test_batch_shapes(shape: tuple[int, ...]) -> None:
    a = np.random.default_rng(1).normal(size=(*shape, 4))
    for result in (yaw.inverse(a), yaw.compose(a, np.zeros(4))):
        assert result.shape == a.shape
    assert yaw.to_pose(a).shape == (*shape, 7)
    assert yaw.from_pose(yaw.to_pose(a)).shape == a.shape
    assert yaw.transform(a, np.ones(3)).shape == (*shape, 3)
