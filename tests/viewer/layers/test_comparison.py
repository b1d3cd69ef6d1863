"""Two maps side by side."""

from __future__ import annotations

import numpy as np
import pytest

from maplab_py.viewer import colours
from maplab_py.viewer.building import Subject, build_scene
from maplab_py.viewer.scene import Points, Scene, Segments
from maplab_py.vimap import VIMap
from maplab_py.vimap.merge import merge_maps
from tests.vimap.builders import walk_map


def _both(vi_map: VIMap, other: VIMap) -> tuple[Scene, Segments, Points]:
    scene = build_scene(
        Subject(vi_map, "after", other=other, other_name="snapshot 'before'", side_by_side=True)
    )
    path = scene.layer("reference_trajectories").parts[""]
    names = scene.layer("names").parts[""]
    assert isinstance(path, Segments)
    assert isinstance(names, Points)
    return scene, path, names


@pytest.fixture(scope="module")
def two_missions() -> VIMap:
    return merge_maps(walk_map(seed=1), walk_map(vertices=9, seed=2, first_ns=10**10))[0]


def test_another_state_lies_beside_the_map_along_its_longer_side(two_missions: VIMap) -> None:
    scene, path, names = _both(two_missions, two_missions)
    shift = path.ends[0, 0] - two_missions.T_G_I[0, 4:]
    np.testing.assert_allclose(
        path.ends[:, 0], two_missions.T_G_I[path.rows, 4:] + shift, atol=1e-4
    )
    outline = build_scene(Subject(two_missions)).extent.outline
    across = int(np.argmin(np.ptp(outline[:, :2], axis=0)))
    assert np.count_nonzero(np.abs(shift) > 1e-4) == 1
    assert shift[across] < -np.ptp(outline[:, across])
    assert names.labels == ("after", "snapshot 'before'")
    np.testing.assert_allclose(names.p[1] - names.p[0], shift, atol=1e-4)
    assert scene.notes[0] == "beside it: snapshot 'before'"
    seen = np.concatenate([names.p, path.ends[:, 0]])
    low, high = scene.extent.outline.min(axis=0), scene.extent.outline.max(axis=0)
    assert ((seen >= low - 1.5) & (seen <= high + 1.5)).all()


def test_missions_have_one_colour_on_both_sides(two_missions: VIMap) -> None:
    _, path, _ = _both(two_missions, two_missions)
    expected = colours.mission_colours(2)[two_missions.vertices.mission[path.rows]]
    np.testing.assert_array_equal(path.colours, expected)


def test_a_map_with_nothing_in_common_is_centred_and_has_new_colours(two_missions: VIMap) -> None:
    stranger = walk_map(seed=9)
    base = stranger.baseframes
    T = np.array(base.T_G_M)
    T[:, 4:] += [5_000.0, 300.0, 20.0]
    far = stranger.replace(baseframes=base.replace(T_G_M=T))
    scene, path, _ = _both(two_missions, far)
    assert np.abs(path.ends - scene.extent.centre).max() < 4.0 * scene.extent.radius_m
    assert (path.colours == colours.mission_colours(3)[2]).all()
    cloud = scene.layer("reference_landmarks").parts[""]
    assert isinstance(cloud, Points)
    assert (cloud.colours == colours.mission_colours(3)[2]).all()
