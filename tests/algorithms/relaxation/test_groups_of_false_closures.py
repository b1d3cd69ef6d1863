"""False closures that agree with one another, which random ones never do."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from maplab_py.algorithms.relaxation.options import RelaxationOptions
from maplab_py.algorithms.relaxation.relaxation import relax_graph
from maplab_py.geometry import se3, so3
from maplab_py.vimap.ids import random_ids
from maplab_py.vimap.tables import LoopClosureEdges
from tests.algorithms.relaxation.loops import Loop, ate, simulate

OPTIONS = RelaxationOptions()


def raised(T_A_B: np.ndarray, T_G_A: np.ndarray, height_m: float) -> np.ndarray:
    """Return relative poses whose second pose lies higher in G."""
    moved = T_A_B.copy()
    moved[:, 4:] += so3.rotate(so3.inverse(T_G_A[:, :4]), [0.0, 0.0, height_m])
    return moved


def with_false_neighbours(loop: Loop, count: int, height_m: float, seed: int) -> Loop:
    """Add closures of neighbouring vertices that all put the second lap too high."""
    rng = np.random.default_rng(seed)
    first = int(rng.integers(20, 260)) + np.arange(count) // 2
    second = first + 300
    T_A_B = se3.relative(loop.T_G_I[first], loop.T_G_I[second])
    false = LoopClosureEdges.filled(
        count,
        id=random_ids(count, rng),
        from_vertex=first,
        to_vertex=second,
        T_A_B=raised(T_A_B, loop.T_G_I[first], height_m),
        covariance=loop.closures.covariance[:count],
    )
    closures = LoopClosureEdges.concatenate([loop.closures, false])
    return dataclasses.replace(loop, closures=closures)


@pytest.mark.parametrize(("seed", "height_m"), [(1, 0.5), (3, 0.6)])
def test_false_neighbours_that_bend_the_trajectory_are_judged_without_them(seed, height_m):
    # while they count, their errors are no larger than those of a tail of true closures
    loop = with_false_neighbours(simulate(seed, false_share=0.0), 4, height_m, seed)
    relaxed = relax_graph(loop.vi_map, OPTIONS, loop_closures=loop.closures)
    assert relaxed.weight.tolist() == [1.0] * 80 + [0.0] * 4


def test_a_confident_minority_does_not_outvote_the_majority():
    # 30 closures put the second lap 5 m too high; the 50 true ones are five times less certain
    loop = simulate(0, false_share=0.0)
    rows = np.sort(np.random.default_rng(0).permutation(80)[:30])
    others = np.setdiff1d(np.arange(80), rows)
    T_A_B, covariance = loop.closures.T_A_B.copy(), loop.closures.covariance.copy()
    T_A_B[rows] = raised(T_A_B[rows], loop.T_G_I[loop.closures.from_vertex[rows]], 5.0)
    covariance[others] *= 25.0
    closures = loop.closures.replace(T_A_B=T_A_B, covariance=covariance)
    relaxed = relax_graph(loop.vi_map, OPTIONS, loop_closures=closures)
    assert np.all(relaxed.weight[others] == 1.0)
    assert np.all(relaxed.weight[rows] == 0.0)
    assert ate(relaxed.vi_map.T_G_I, loop.T_G_I) < 0.2
