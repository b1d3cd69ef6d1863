"""What tests rely on: association, IMU model, collection, waiting, planted faults."""

import itertools

import numpy as np
import pytest
from hypothesis import strategies as st

from maplab_py.algorithms.self_calibration.pruning import test_mutual_consistency, test_segments
from maplab_py.geometry import interpolation, so3
from maplab_py.sensors import ImuIntrinsics
from tests.mutation.fault import planted
from tests.mutation.faults import AREAS
from tests.support import data, imu_model, waiting

stamps = st.lists(st.integers(0, 60), max_size=12, unique=True).map(sorted).map(np.array)


def exhaustive(a: np.ndarray, b: np.ndarray, tolerance: int) -> list[tuple[int, int]]:
    b_is_longer = len(b) > len(a)
    short, long = (a, b) if b_is_longer else (b, a)
    pairs = []
    for i, time in enumerate(short):
        difference = np.abs(long - time)
        j = int(np.argmin(difference))
        if difference[j] <= tolerance:
            pairs.append((i, j) if b_is_longer else (j, i))
    return pairs


def test_nearest_rows_of_one_stamp() -> None:
    assert interpolation.nearest_rows([5], [1, 5, 9]).tolist() == [0, 0, 0]
    assert interpolation.nearest_rows([0, 10], [5, 6, -3, 40]).tolist() == [0, 1, 0, 1]


def test_the_equations() -> None:
    rng = np.random.default_rng(1)
    T_g, T_a = (np.eye(3) + np.triu(rng.normal(size=(3, 3))) * 0.02 for _ in range(2))
    R_A_I = so3.to_matrix(so3.exp(rng.normal(size=3)))
    b_a, b_g, f, w = rng.normal(size=(4, 3))
    out = imu_model.distort_imu(ImuIntrinsics(T_g, T_a, R_A_I), np.concatenate([f, w]), b_a, b_g)
    assert np.allclose(out[:3], T_a @ (R_A_I @ f) + b_a)
    assert np.allclose(out[3:], T_g @ w + b_g)


def test_correction_inverts_and_batches() -> None:
    rng = np.random.default_rng(2)
    T = np.eye(3) + np.triu(rng.normal(size=(3, 3))) * 0.02
    R_A_I = so3.to_matrix(so3.exp(rng.normal(size=3)))
    values, biases = rng.normal(size=(4, 5, 6)), rng.normal(size=(2, 4, 1, 3))
    for intrinsics in (None, ImuIntrinsics(T, T.copy(), R_A_I)):
        reported = imu_model.distort_imu(intrinsics, values, *biases)
        assert reported.shape == values.shape
        assert np.max(np.abs(imu_model.correct_imu(intrinsics, reported, *biases) - values)) < 1e-13


def test_no_intrinsics_adds_biases_only() -> None:
    out = imu_model.distort_imu(None, np.arange(6.0), [1, 2, 3], [10, 20, 30])
    assert out.tolist() == [1, 3, 5, 13, 24, 35]


def test_functions_of_the_product_are_not_collected(request: pytest.FixtureRequest) -> None:
    collected = {item.name for item in request.session.items if item.path == request.path}
    assert request.node.name in collected
    assert not collected & {test_segments.__name__, test_mutual_consistency.__name__}


def test_waiting_ends_with_the_condition_or_the_time() -> None:
    numbers = itertools.count()
    assert waiting.wait_until(lambda: next(numbers) == 3)
    assert not waiting.wait_until(lambda: False, at_most_s=0.02)


@pytest.mark.parametrize("area", AREAS)
def test_faults_can_be_planted_and_name_tests(area: str) -> None:
    for fault in AREAS[area]:
        planted(fault, (data.REPOSITORY / fault.file).read_text(encoding="utf-8"))
        for test in fault.tests:
            assert (data.REPOSITORY / test.partition("::")[0]).exists(), fault.name
