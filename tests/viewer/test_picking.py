"""A click finds what is under it, and the panel says what that is."""

from __future__ import annotations

import numpy as np
import pytest

from maplab_py.viewer.building import Subject, build_scene
from maplab_py.viewer.facts import facts
from maplab_py.viewer.picking import pick
from maplab_py.viewer.scene import Entity
from maplab_py.vimap.ids import to_hex
from tests.vimap.builders import walk_map

MAP = walk_map(vertices=14, landmarks=80, seed=3)
SCENE = build_scene(Subject(MAP))
EYE = SCENE.extent.centre + np.array([-6.0, -9.0, 7.0])


@pytest.mark.parametrize("row", range(14))
def test_every_vertex_can_be_picked(row: int) -> None:
    found = pick(SCENE, EYE, MAP.T_G_I[row, 4:] - EYE)
    assert found is not None
    assert (found.entity, found.row) == (Entity.VERTEX, row)
    assert found.angle_rad < 1e-3


@pytest.mark.parametrize("row", range(0, 80, 9))
def test_landmarks_can_be_picked(row: int) -> None:
    found = pick(SCENE, EYE, MAP.p_G[row] - EYE, layers={"landmarks"})
    assert found is not None
    assert (found.entity, found.row) == (Entity.LANDMARK, row)


def test_a_loop_closure_is_picked_along_its_line() -> None:
    edges = MAP.loop_closure_edges
    ends = MAP.T_G_I[[edges.from_vertex[0], edges.to_vertex[0]], 4:]
    target = 0.7 * ends[0] + 0.3 * ends[1]
    found = pick(SCENE, EYE, target - EYE, layers={"loop_closures"})
    assert found is not None
    assert (found.entity, found.row) == (Entity.LOOP_CLOSURE, 0)
    np.testing.assert_allclose(found.p, target, atol=0.02)


def test_hidden_things_and_things_behind_are_not_picked() -> None:
    ray = MAP.T_G_I[5, 4:] - EYE
    assert pick(SCENE, EYE, ray, layers=set()) is None
    assert pick(SCENE, EYE, ray, missions=set(), layers={"vertices"}) is None
    assert pick(SCENE, EYE, -ray) is None
    assert pick(SCENE, EYE, [0.0, 0.0, 1.0]) is None


def test_the_front_one_of_two_on_a_line_is_picked() -> None:
    p = MAP.T_G_I[:, 4:]
    eye = p[3] + 0.2 * (p[3] - p[9]) / np.linalg.norm(p[3] - p[9])
    found = pick(SCENE, eye, p[9] - eye, layers={"vertices"})
    assert found is not None
    assert found.row == 3


def _value(entity: Entity, row: int, name: str) -> str:
    return dict(facts(MAP, entity, row))[name]


def test_facts_of_a_vertex() -> None:
    assert _value(Entity.VERTEX, 4, "vertex") == to_hex(MAP.vertices.id[4])
    assert _value(Entity.VERTEX, 4, "time") == "0.400 s after the start"
    assert _value(Entity.VERTEX, 4, "number") == "5 of 14"
    observed = MAP.keypoints.landmark[MAP.keypoint_vertex == 4]
    assert _value(Entity.VERTEX, 4, "observations") == str((observed >= 0).sum())
    assert _value(Entity.VERTEX, 4, "reprojection error") == "mean 0.00 px, largest 0.00 px"


def test_facts_of_a_landmark() -> None:
    row = int(np.argmax(np.diff(MAP.observation_start)))
    keypoints = MAP.landmark(row).keypoints
    vertices = np.unique(MAP.keypoint_vertex[keypoints])
    assert _value(Entity.LANDMARK, row, "landmark") == to_hex(MAP.landmarks.id[row])
    text = f"{len(keypoints)} by {len(vertices)} vertices"
    assert _value(Entity.LANDMARK, row, "observations") == text
    assert _value(Entity.LANDMARK, row, "quality") == "good"
    assert _value(Entity.LANDMARK, row, "reprojection error").startswith("mean 0.00 px")
    shifted = np.array(MAP.keypoints.uv_px)
    shifted[keypoints, 0] += 3.0
    worse = MAP.replace(keypoints=MAP.keypoints.replace(uv_px=shifted))
    error = dict(facts(worse, Entity.LANDMARK, row))["reprojection error"]
    assert error == "mean 3.00 px, largest 3.00 px"


def test_facts_of_a_loop_closure() -> None:
    edges = MAP.loop_closure_edges
    named = dict(facts(MAP, Entity.LOOP_CLOSURE, 1))
    assert named["query vertex"] == to_hex(MAP.vertices.id[edges.from_vertex[1]])
    assert named["target vertex"] == to_hex(MAP.vertices.id[edges.to_vertex[1]])
    # the edge says the two are at the same place
    p = MAP.T_G_I[[edges.from_vertex[1], edges.to_vertex[1]], 4:]
    assert named["correction"] == f"{np.linalg.norm(p[1] - p[0]):.3f} m"
    assert named["switch value"] == "1.000"
