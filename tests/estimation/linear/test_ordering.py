"""Orderings, and conjugate gradients without one."""

import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.linalg import cho_factor, cho_solve

from maplab_py.array_types import F64
from maplab_py.errors import FlagError
from maplab_py.estimation.linear import nested_dissection, ordering, protocol, quotient_graph
from maplab_py.estimation.linear.conjugate_gradients import CGResult, Operator, conjugate_gradients
from maplab_py.estimation.linear.nested_dissection import dissect_by_position, has_metis
from maplab_py.estimation.linear.ordering import (
    Ordering,
    OrderingKind,
    minimum_degree,
    minimum_degree_of_groups,
)
from maplab_py.estimation.linear.pattern import BlockPattern
from maplab_py.estimation.linear.symbolic import analyse
from tests.estimation.linear.systems import STRUCTURES, system
from tests.support.data import REPOSITORY

needs_metis = pytest.mark.skipif(not has_metis(), reason="pymetis is not installed")


def _pattern(name: str) -> BlockPattern:
    rows, cols, n, _, _ = system(name, 1, seed=3)
    return BlockPattern.checked(rows, cols, n, 3)


def _sessions_on_a_loop(sessions: int, keyframes: int) -> tuple[BlockPattern, np.ndarray]:
    """Sessions walk the same circle of 200 m; keyframes within 3 m share two nodes each.

    Returns the pattern of five nodes a keyframe and the position of every node.
    """
    rng = np.random.default_rng(0)
    along_m = np.concatenate(
        [np.arange(keyframes) * 0.75 + rng.uniform(0, 200) for _ in range(sessions)]
    )
    apart_m = np.abs(along_m[:, None] - along_m) % 200.0
    high, low = np.nonzero(np.tril(np.minimum(apart_m, 200.0 - apart_m) < 3.0, -1))
    after = np.flatnonzero(np.arange(1, len(along_m)) % keyframes != 0) + 1
    every = np.arange(len(along_m))
    pairs = [(5 * high + i, 5 * low + j) for i in range(2) for j in range(2)]
    pairs += [(5 * after + i, 5 * (after - 1) + j) for i in range(5) for j in range(5)]
    pairs += [(5 * every + i, 5 * every + j) for i in range(5) for j in range(i + 1)]
    rows, cols = (np.concatenate(part) for part in zip(*pairs, strict=True))
    angle = along_m * 2.0 * np.pi / 200.0
    circle = np.column_stack([32 * np.cos(angle), 32 * np.sin(angle), np.zeros(len(angle))])
    return BlockPattern.checked(rows, cols, 5 * len(along_m), 3), np.repeat(circle, 5, axis=0)


def _without_groups(pattern: BlockPattern) -> quotient_graph.QuotientGraph:
    """Make every node of a pattern a group."""
    n = pattern.num_nodes
    off_diagonal = pattern.rows != pattern.cols
    key = np.unique(pattern.rows[off_diagonal].astype(np.int64) * n + pattern.cols[off_diagonal])
    return quotient_graph.QuotientGraph(np.arange(n), np.ones(n, dtype=np.int64), key // n, key % n)


def _dense_columns(pattern: BlockPattern, order: np.ndarray) -> np.ndarray:
    """Return the nodes below the diagonal of each factor column, by dense elimination."""
    n = pattern.num_nodes
    full = np.zeros((n, n), dtype=bool)
    full[pattern.rows, pattern.cols] = full[pattern.cols, pattern.rows] = True
    full = full[np.ix_(order, order)]
    below = np.zeros(n)
    for k in range(n):
        rows = np.flatnonzero(full[k + 1 :, k]) + k + 1
        full[np.ix_(rows, rows)] = True
        below[k] = len(rows)
    return below


@pytest.mark.parametrize("name", STRUCTURES)
@pytest.mark.parametrize("kind", OrderingKind)
def test_orders_are_permutations(
    name: str, kind: OrderingKind, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ordering, "_WORTH_ANOTHER", 0.0)
    pattern = _pattern(name)
    position_m = np.random.default_rng(1).normal(size=(pattern.num_nodes, 3))
    order = Ordering(kind, position_m)(pattern)
    np.testing.assert_array_equal(np.sort(order), np.arange(pattern.num_nodes))


@pytest.mark.parametrize("name", STRUCTURES)
def test_predicted_work_is_that_of_a_dense_elimination(name: str) -> None:
    pattern = _pattern(name)
    graph = _without_groups(pattern)
    order = np.random.default_rng(5).permutation(pattern.num_nodes)
    below = 3.0 * _dense_columns(pattern, order)
    assert graph.work(order, 3) == pytest.approx(np.sum(9.0 + 9.0 * below + 3.0 * below**2))


def test_another_scipy_gives_the_same_order(monkeypatch: pytest.MonkeyPatch) -> None:
    pattern, _ = _sessions_on_a_loop(2, 40)
    order = minimum_degree(pattern)
    moved = SimpleNamespace(gstrf=lambda *_, **__: len(None))  # raises TypeError
    monkeypatch.setattr(ordering, "scipy_extension", lambda name: moved)
    np.testing.assert_array_equal(minimum_degree(pattern), order)


def test_work_of_groups_is_that_of_their_nodes() -> None:
    pattern, _ = _sessions_on_a_loop(2, 40)
    graph, single = quotient_graph.QuotientGraph.of(pattern), _without_groups(pattern)
    assert len(graph) < len(single)
    order = minimum_degree_of_groups(graph)
    # a group's triangle: its columns one by one have the same entries
    by_nodes = single.work(graph.order_of_nodes(order), 1)
    assert graph.work(order, 1) == pytest.approx(by_nodes, rel=0.05)


@needs_metis
def test_overlapping_sessions_take_a_fraction_of_the_work() -> None:
    pattern, _ = _sessions_on_a_loop(10, 300)
    least = analyse(pattern, Ordering()).statistics
    dissected = analyse(pattern, Ordering(OrderingKind.NESTED_DISSECTION)).statistics
    degree = analyse(pattern, Ordering(OrderingKind.MINIMUM_DEGREE)).statistics
    assert least == dissected
    assert least.flops < 0.1 * degree.flops
    assert least.nonzeros < 0.4 * degree.nonzeros


def test_cuts_by_position_replace_metis(monkeypatch: pytest.MonkeyPatch) -> None:
    pattern, position_m = _sessions_on_a_loop(10, 300)
    monkeypatch.setattr(ordering, "has_metis", lambda: False)
    least = analyse(pattern, Ordering(position_m=position_m)).statistics
    degree = analyse(pattern, minimum_degree).statistics
    assert least.nonzeros < 0.4 * degree.nonzeros
    assert analyse(pattern, Ordering()).statistics == degree
    with pytest.raises(FlagError, match="pip install pymetis"):
        Ordering(OrderingKind.NESTED_DISSECTION)(pattern)


def test_cuts_separate_and_nodes_without_position_come_last(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(nested_dissection, "_LEAF", 4)
    pattern = _pattern("chain")
    graph = _without_groups(pattern)
    position_m = np.random.default_rng(2).normal(size=(40, 3))
    position_m[[7, 20]] = np.nan
    order = dissect_by_position(graph, position_m)
    assert set(order[-2:]) == {7, 20}
    parts = dissect_by_position(_without_groups(_pattern("singletons")), np.eye(7, 3))
    assert sorted(parts) == list(range(7))


def test_small_systems_ask_for_a_single_order(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(graph: quotient_graph.QuotientGraph) -> None:
        raise AssertionError("a second order costs more than it saves")

    monkeypatch.setattr(ordering, "dissect_by_metis", refuse)
    pattern, _ = _sessions_on_a_loop(4, 100)
    np.testing.assert_array_equal(Ordering()(pattern), minimum_degree(pattern))


@needs_metis
def test_orders_are_the_same_in_every_process() -> None:
    program = (
        "import sys; sys.path.append(sys.argv[1])\n"
        "from tests.estimation.linear.test_ordering import _sessions_on_a_loop, Ordering, OrderingKind\n"
        "import hashlib\n"
        "order = Ordering(OrderingKind.NESTED_DISSECTION)(_sessions_on_a_loop(4, 100)[0])\n"
        "print(hashlib.sha256(order.tobytes()).hexdigest())"
    )
    digests = {
        subprocess.run(
            [sys.executable, "-c", program, str(REPOSITORY)],
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for _ in range(2)
    }
    assert len(digests) == 1


def test_metis_is_imported_only_when_it_is_used() -> None:
    program = (
        "import sys, maplab_py.estimation.linear.block_cholesky\nsys.exit('pymetis' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0


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
    with pytest.raises(protocol.NotPositiveDefinite) as error:
        conjugate_gradients(
            product_with(matrix), lambda r: r, np.eye(2, 3, 2) + np.eye(2, 3, 1),
            forcing=1e-9, max_iterations=10,
        )  # fmt: skip
    assert error.value.node in (0, 1)
