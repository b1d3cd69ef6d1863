"""The optimum is that of other optimisers, on one problem with the same residuals.

Ceres (through pycolmap) has the visual problem, GTSAM the visual-inertial one; both are run until
no step lowers the cost noticeably. GTSAM preintegrates by slightly other rules (see
`benchmarks.gtsam_solver`), so its costs are compared both ways: each solver's optimum must be
as good in the other's eyes as its own.
"""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import maplab_solver
from benchmarks.problems import make_inertial, make_visual
from benchmarks.solution import Solution, StoppingRule
from maplab_py.estimation.problem.trust_region import Schedule
from maplab_py.geometry import se3

TIGHT = StoppingRule(function_tolerance=1e-12)
NO_PEER = "the extra [bench] is not installed"


def relative(a: float, b: float) -> float:
    return abs(a - b) / b


def pose_errors(one: Solution, two: Solution) -> tuple[float, float]:
    """Return the largest difference of positions [m] and of orientations [rad]."""
    difference = se3.local(one.T_G_I, two.T_G_I)
    return tuple(np.linalg.norm(part, axis=1).max() for part in np.split(difference, 2, axis=1))


def test_visual_optimum_is_that_of_ceres() -> None:
    pytest.importorskip("pycolmap", "4.2", reason=NO_PEER)
    from benchmarks import ceres_solver

    problem = make_visual("tiny")
    ours, _ = maplab_solver.solve_visual(problem, TIGHT)
    theirs, _ = ceres_solver.solve_visual(problem, TIGHT)
    assert relative(ours.cost, theirs.cost) <= 1e-10
    assert relative(maplab_solver.cost_of(problem, theirs), theirs.cost) <= 1e-10
    position_m, orientation_rad = pose_errors(ours, theirs)
    assert position_m <= 1e-5
    assert orientation_rad <= 1e-6
    assert np.linalg.norm(ours.p_G - theirs.p_G, axis=1).max() <= 1e-4


def test_inertial_optimum_is_that_of_gtsam() -> None:
    pytest.importorskip("gtsam", reason=NO_PEER)
    from benchmarks import gtsam_solver

    problem = make_inertial("tiny")
    ours, _ = maplab_solver.solve_inertial(problem, TIGHT)
    theirs, _ = gtsam_solver.solve_inertial(problem, TIGHT)
    assert relative(ours.cost, theirs.cost) <= 1e-6
    assert relative(maplab_solver.cost_of(problem, theirs), ours.cost) <= 1e-6
    assert relative(gtsam_solver.cost_of(problem, ours), theirs.cost) <= 1e-6
    position_m, orientation_rad = pose_errors(ours, theirs)
    assert position_m <= 1e-4
    assert orientation_rad <= 1e-5
    assert np.linalg.norm(ours.v_G - theirs.v_G, axis=1).max() <= 1e-4
    assert np.abs(ours.gyro_bias - theirs.gyro_bias).max() <= 1e-6
    assert np.abs(ours.accel_bias - theirs.accel_bias).max() <= 1e-4


@pytest.mark.slow
def test_costs_agree_on_a_larger_problem_too() -> None:
    pytest.importorskip("pycolmap", "4.2", reason=NO_PEER)
    from benchmarks import ceres_solver

    problem, rule = make_visual("small"), StoppingRule(function_tolerance=1e-9)
    ours, _ = maplab_solver.solve_visual(problem, rule)
    theirs, _ = ceres_solver.solve_visual(problem, rule)
    assert relative(ours.cost, theirs.cost) <= 1e-8


def test_ceres_schedule_goes_the_way_of_ceres() -> None:
    """With the same schedule and damping the costs of each iteration are the same, too.

    Not to the last digit: Ceres scales by other tangents (camera from world), which damps otherwise.
    """
    pytest.importorskip("pycolmap", "4.2", reason=NO_PEER)
    from benchmarks import ceres_solver

    problem = make_visual("tiny")
    for iterations in (1, 2, 3):
        rule = StoppingRule(0.0, iterations, 1e-4, schedule=Schedule.CERES)
        ours, _ = maplab_solver.solve_visual(problem, rule)
        theirs, _ = ceres_solver.solve_visual(problem, rule)
        assert relative(ours.cost, theirs.cost) <= 1e-4
