"""Submaps give the steps of the direct solver, in less memory."""

import itertools
import tempfile
from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import EstimationError
from maplab_py.estimation.linear import protocol, submap_solver
from maplab_py.estimation.linear.ordering import Ordering, OrderingKind
from maplab_py.estimation.linear.pattern import BlockPattern
from maplab_py.estimation.linear.symbolic import analyse
from maplab_py.estimation.loss import Loss
from maplab_py.estimation.problem.marginals import Marginals
from maplab_py.estimation.problem.problem import Problem
from maplab_py.estimation.problem.solver import SolverOptions, optimize_states
from maplab_py.estimation.problem.submaps import SubmapProblem
from maplab_py.estimation.states import NODES_PER_VERTEX, ORIENTATION, POSITION
from maplab_py.estimation.terms.protocol import FactorTerm
from maplab_py.progress import SILENT
from tests.estimation.problem.test_iterative import loop_edges, problem_of
from tests.support.dense import DenseProblem

DAMPING = 1e-4


def long_problem(**options: object) -> DenseProblem:
    """Return a walk of 40 vertices, of which neighbours share landmarks."""
    return problem_of(vertices=40, landmarks=400, **options)


def pair(
    dense: DenseProblem, submaps: int, factors: tuple[FactorTerm, ...] = ()
) -> tuple[Problem, SubmapProblem]:
    terms = [*dense.factors, *factors]
    made = (
        Problem(dense.states, dense.visual, terms),
        SubmapProblem(dense.states, dense.visual, terms, submaps),
    )
    for problem in made:
        problem.relinearize(dense.states)
        problem.fix(np.array([POSITION, ORIENTATION]))
        half = np.diag([1.0, 1.0, 0.0])[None]
        problem.restrict(np.array([NODES_PER_VERTEX * 20 + ORIENTATION]), half)
    return made


@pytest.mark.parametrize("submaps", [1, 2, 5, 50])
@pytest.mark.parametrize("name", ["visual-inertial", "loops", "robust", "fixed points", "images"])
def test_steps_and_costs_are_those_of_the_direct_solver(name: str, submaps: int) -> None:
    options = {
        "robust": {"loss": Loss.CAUCHY},
        "fixed points": {"move_points": False},
        "images": {"include_inertial": False},
    }.get(name, {})
    dense = long_problem(**options)
    factors = (loop_edges(dense),) if name == "loops" else ()
    direct, split = pair(dense, submaps, factors)
    if name == "images":  # the scale is not observable
        for problem in (direct, split):
            problem.fix(np.array([NODES_PER_VERTEX * 39 + POSITION]))
            held = NODES_PER_VERTEX * np.arange(40)[:, None] + np.arange(2, NODES_PER_VERTEX)
            problem.fix(held.reshape(-1))
    assert 1 <= split.num_submaps <= submaps
    expected = direct.linearize(dense.states, DAMPING)
    linear = split.linearize(dense.states, DAMPING)
    assert linear.costs == pytest.approx(expected.costs, rel=1e-12)
    assert linear.gradient == pytest.approx(expected.gradient, rel=1e-9, abs=1e-6)
    step = direct.try_step(dense.states, expected, DAMPING)
    other = split.try_step(dense.states, linear, DAMPING)
    assert other.cost == pytest.approx(step.cost, rel=1e-9)
    assert other.promised == pytest.approx(step.promised, rel=1e-9)
    size = np.abs(step.states.T_G_I - dense.states.T_G_I).max()
    assert pytest.approx(step.states.T_G_I, abs=1e-7 * size) == other.states.T_G_I


def test_another_damping_than_that_of_the_landmarks() -> None:
    dense = long_problem()
    direct, split = pair(dense, 4)
    expected = direct.solve(direct.linearize(dense.states, DAMPING), 0.1)
    linear = split.linearize(dense.states, DAMPING)
    for _ in range(2):  # the second time everything is eliminated again
        step = split.solve(linear, 0.1)
        assert step == pytest.approx(expected, abs=1e-7 * np.abs(expected).max())
    first = split.solve(linear, DAMPING)
    assert np.array_equal(split.solve(linear, DAMPING), first)


def test_the_optimum_is_the_joint_one() -> None:
    dense = long_problem(loss=Loss.CAUCHY)
    options = SolverOptions(num_iterations=30, function_tolerance=1e-12)
    costs, states = [], []
    for problem in pair(dense, 4):
        final, summary = optimize_states(problem, dense.states, options, SILENT)
        costs.append(sum(summary.final_costs.values()))
        states.append(final)
    assert costs[1] == pytest.approx(costs[0], rel=1e-10)
    assert pytest.approx(states[0].T_G_I, abs=1e-6) == states[1].T_G_I


def test_the_same_bits_each_time() -> None:
    dense = long_problem()
    steps = []
    for _ in range(2):
        _, split = pair(dense, 3)
        steps.append(split.solve(split.linearize(dense.states, DAMPING), DAMPING))
    assert np.array_equal(steps[0], steps[1])


def test_weights_that_change_are_used() -> None:
    dense = long_problem()
    assert dense.visual is not None
    direct, split = pair(dense, 3)
    data = dense.visual.observations
    is_used = np.arange(len(data)) % 7 != 0
    dense.visual.use(data.switched(is_used, 1.0 / data.inverse_sigma))
    expected = direct.linearize(dense.states, DAMPING).costs["visual"]
    assert split.linearize(dense.states, DAMPING).costs["visual"] == pytest.approx(expected)
    dense.visual.use(data)
    assert split.linearize(dense.states, DAMPING).costs["visual"] > expected


def test_singular_equations_are_told_when_the_step_is_asked_for() -> None:
    dense = long_problem(include_inertial=False)
    split = SubmapProblem(dense.states, dense.visual, dense.factors, 3)
    linear = split.linearize(dense.states, 0.0)
    with pytest.raises(protocol.NotPositiveDefinite):
        split.solve(linear, -2.0)


def test_covariances_are_those_of_the_direct_solver() -> None:
    dense = long_problem()
    direct, split = pair(dense, 3)
    expected = Marginals(direct, dense.states).poses([7, 30])
    assert Marginals(split, dense.states).poses([7, 30]) == pytest.approx(expected)


def test_a_disk_that_refuses_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    dense = long_problem()
    _, split = pair(dense, 3)

    class Full:
        def seek(self, place: int) -> None:
            pass

        def write(self, data: memoryview) -> int:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(split._submaps, "_file", Full())
    with pytest.raises(EstimationError, match=r"No space left on device.*TMPDIR"):
        split.linearize(dense.states, DAMPING)


def test_nothing_is_left_in_the_temporary_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    dense = long_problem()
    _, split = pair(dense, 3)
    split.solve(split.linearize(dense.states, DAMPING), DAMPING)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", list(OrderingKind))
@pytest.mark.parametrize("count", [1, 3, 8])
def test_submaps_share_no_block_and_the_factor_is_the_same(kind: OrderingKind, count: int) -> None:
    """A long band: what two submaps have in common lies in the separators."""
    n = 400
    far = (
        np.repeat(np.arange(n), 6),
        np.clip(np.repeat(np.arange(n), 6) - np.tile(np.arange(6), n), 0, None),
    )
    pattern = BlockPattern.checked(*far, n, 3)
    position_m = np.column_stack([np.arange(n), np.zeros(n), np.zeros(n)]).astype(float)
    symbolic = analyse(pattern, Ordering(kind, position_m))
    submaps = submap_solver.cut_into_submaps(symbolic, count)
    assert 1 <= sum(submaps.is_submap) <= count
    part = submaps.part_of_nodes()
    for a, b in np.unique(np.column_stack([part[pattern.rows], part[pattern.cols]]), axis=0):
        assert max(a, b) in submaps.path(min(a, b))
    sizes = [submaps.size_of(k) for k in range(len(submaps))]
    assert sum(sizes) == symbolic.statistics.nonzeros
    for k in range(len(submaps)):
        held = submaps.path(k)
        places = [(int(submaps.offset[p]), int(submaps.offset[p]) + sizes[p]) for p in held]
        assert all(below[1] == above[0] for below, above in itertools.pairwise(places))
        assert places[0][0] >= 0
        assert places[-1][1] == submaps.room
    fresh = [p for k in range(len(submaps)) for p in submaps.begins_with(k)]
    assert sorted(fresh) == list(range(len(submaps)))
    assert sorted(submaps.plan.order.tolist()) == list(range(n))
    if count == 8 and kind is OrderingKind.NESTED_DISSECTION:
        assert submaps.room < 0.3 * symbolic.statistics.nonzeros
