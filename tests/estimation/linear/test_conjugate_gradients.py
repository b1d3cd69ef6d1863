"""Conjugate gradients against Cholesky factors and pseudo-inverses of dense matrices."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import cho_factor, cho_solve

from maplab_py.array_types import F64
from maplab_py.estimation.linear.conjugate_gradients import (
    CGResult,
    Operator,
    conjugate_gradients,
)
from maplab_py.estimation.linear.protocol import NotPositiveDefinite


def product_with(matrix: F64) -> Operator:
    return lambda x: (matrix @ x.reshape(-1)).reshape(-1, 3)


def block_diagonal(matrix: F64) -> F64:
    blocks = np.kron(np.eye(len(matrix) // 3), np.ones((3, 3)))
    return np.asarray(np.where(blocks > 0.0, matrix, 0.0))


def solved(matrix: F64, b: F64, **options: object) -> CGResult:
    """Solve with the inverse of the diagonal blocks as preconditioner."""
    settings = {"forcing": 1e-13, "max_iterations": 20 * len(matrix), **options}
    M_inverse = np.linalg.pinv(block_diagonal(matrix))
    return conjugate_gradients(product_with(matrix), product_with(M_inverse), b, **settings)  # type: ignore[arg-type]


def random_jacobian(rng: np.random.Generator, rank_deficiency: int) -> F64:
    """Return J (m, n) with column scales over four decades and a null space of some dimensions."""
    n = 3 * int(rng.integers(3, 25))
    J = rng.normal(size=(2 * n, n)) * 10.0 ** rng.uniform(-2.0, 2.0, n)
    basis = np.linalg.qr(rng.normal(size=(n, rank_deficiency)))[0]
    return np.asarray(J - J @ basis @ basis.T)


@pytest.mark.parametrize("seed", range(20))
def test_regular_systems_against_cholesky(seed: int) -> None:
    rng = np.random.default_rng(seed)
    J = random_jacobian(rng, 0)
    A, b = J.T @ J, rng.normal(size=(J.shape[1] // 3, 3))
    result = solved(A, b)
    wanted = cho_solve(cho_factor(A), b.reshape(-1)).reshape(-1, 3)
    assert result.has_converged
    scale = np.sqrt(np.diag(A)).reshape(-1, 3)  # sizes of the unknowns differ by decades
    error = np.linalg.norm(scale * (result.x - wanted))
    assert error <= 1e-9 * np.linalg.norm(scale * wanted)


@pytest.mark.parametrize("seed", range(10))
def test_rank_deficient_systems_against_the_pseudo_inverse(seed: int) -> None:
    rng = np.random.default_rng(seed)
    J = random_jacobian(rng, 1 + seed % 6)
    b = J.T @ rng.normal(size=len(J))  # in the range of A, as every gradient is
    result = solved(J.T @ J, b.reshape(-1, 3), forcing=1e-9)
    assert result.has_converged
    wanted = np.linalg.lstsq(J, np.linalg.lstsq(J.T, b, rcond=1e-10)[0], rcond=1e-10)[0]
    fitted = J @ result.x.reshape(-1)  # the null space is free, what is measured is not
    np.testing.assert_allclose(fitted, J @ wanted, atol=1e-7 * np.abs(J @ wanted).max())


def test_the_forcing_bounds_the_preconditioned_residual() -> None:
    rng = np.random.default_rng(3)
    J = random_jacobian(rng, 0)
    A, b = J.T @ J, rng.normal(size=(J.shape[1] // 3, 3))
    M_inverse = np.linalg.inv(block_diagonal(A))

    def size(x: F64) -> float:
        r = b.reshape(-1) - A @ x.reshape(-1)
        return float(r @ M_inverse @ r) ** 0.5

    loose, tight = (solved(A, b, forcing=forcing) for forcing in (1e-2, 1e-4))
    assert size(loose.x) <= 1e-2 * size(np.zeros_like(b))
    assert size(tight.x) <= 1e-4 * size(np.zeros_like(b))
    again = solved(A, b, forcing=1e-4, initial=loose.x)
    assert size(again.x) <= 1e-4 * size(np.zeros_like(b))
    assert loose.iterations < again.iterations + loose.iterations
    assert again.iterations < tight.iterations + loose.iterations


def test_the_limit_is_told() -> None:
    J = random_jacobian(np.random.default_rng(5), 0)
    b = np.ones((J.shape[1] // 3, 3))
    result = solved(J.T @ J, b, max_iterations=2)
    assert (result.iterations, result.has_converged) == (2, False)


def test_nothing_to_do_takes_no_iteration() -> None:
    result = solved(np.eye(6), np.zeros((2, 3)))
    assert (result.iterations, result.has_converged) == (0, True)
    np.testing.assert_array_equal(result.x, 0.0)


@pytest.mark.parametrize("entry", [-1.0, np.nan])
def test_what_is_not_positive_definite_is_refused(entry: float) -> None:
    matrix = np.diag([1.0, 1.0, 1.0, 1.0, 1.0, entry])
    with pytest.raises(NotPositiveDefinite) as error:
        conjugate_gradients(
            product_with(matrix), lambda r: r, np.eye(2, 3, 2) + np.eye(2, 3, 1),
            forcing=1e-9, max_iterations=10,
        )  # fmt: skip
    assert error.value.node in (0, 1)
