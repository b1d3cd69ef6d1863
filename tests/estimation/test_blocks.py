"""Parameter blocks: node numbering, steps on manifolds, bounds, padding."""

from __future__ import annotations

import numpy as np
import pytest

from maplab_py.estimation.blocks import Manifold, ParameterBlock, ParameterBlocks
from maplab_py.geometry import se3, so3


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(3)


def blocks(rng: np.random.Generator) -> ParameterBlocks:
    return ParameterBlocks(
        [
            ParameterBlock("five", rng.normal(size=(2, 5))),
            ParameterBlock("pose", se3.exp(rng.normal(size=(3, 6))), Manifold.POSE),
            ParameterBlock("rotation", so3.exp(rng.normal(size=(1, 3))), Manifold.ROTATION),
            ParameterBlock("switch", np.array([[0.9], [0.1]]), lower=0.0, upper=1.0),
        ]
    )


def test_nodes_follow_one_another_behind_the_vertices(rng: np.random.Generator) -> None:
    some = blocks(rng)
    assert some.num_nodes == 2 * 2 + 3 * 2 + 1 + 2
    assert some.nodes("five", 10).tolist() == [[10, 11], [12, 13]]
    assert some.nodes("pose", 10).tolist() == [[14, 15], [16, 17], [18, 19]]
    assert some.nodes("rotation", 10).tolist() == [[20]]
    assert some.nodes("switch", 10).tolist() == [[21], [22]]


def test_padding_names_the_directions_without_a_parameter(rng: np.random.Generator) -> None:
    nodes, projectors = blocks(rng).padding(10)
    assert nodes.tolist() == [11, 13, 21, 22]
    np.testing.assert_array_equal(projectors[0], np.diag([1, 1, 0]))
    np.testing.assert_array_equal(projectors[2], np.diag([1, 0, 0]))


@pytest.mark.parametrize("name", ["five", "pose", "rotation"])
def test_difference_undoes_a_step(rng: np.random.Generator, name: str) -> None:
    some = blocks(rng)
    step = rng.normal(0, 0.3, (some.num_nodes, 3))
    moved = some.moved(step)[name]
    own = step[some.nodes(name, 0)].reshape(len(moved), -1)[:, : moved.dimension]
    np.testing.assert_allclose(moved.difference(some[name].values), own, atol=1e-12)


def test_steps_stop_at_bounds(rng: np.random.Generator) -> None:
    some = blocks(rng)
    moved = some.moved(np.full((some.num_nodes, 3), 0.5))["switch"]
    np.testing.assert_allclose(moved.values, [[1.0], [0.6]])
