from __future__ import annotations

import numpy as np
import pytest

from maplab_py.algorithms.anchoring.absolute import AbsoluteAnchoringOptions
from maplab_py.algorithms.anchoring.anchoring import anchor_missions
from maplab_py.algorithms.anchoring.options import AnchoringOptions
from maplab_py.geometry import se3, so3, yaw
from maplab_py.vimap import AbsolutePoses
from maplab_py.vimap.ids import to_hex
from tests.algorithms.loop_closure.rooms import Walk, make_map


def scrambled(walks, *, known, seed):
    """Return a map whose base frames are at random places but for the known ones."""
    vi_map, _ = make_map(walks)
    rng = np.random.default_rng(seed)
    count = len(vi_map.missions)
    moved = np.concatenate([rng.uniform(-10, 10, (count, 3)), rng.uniform(-3, 3, (count, 1))], 1)
    is_known = np.isin(np.arange(count), known)
    T_G_M = np.where(is_known[:, None], se3.identity(count), yaw.to_pose(moved))
    return vi_map.replace(baseframes=vi_map.baseframes.replace(T_G_M=T_G_M, is_known=is_known))


THREE = [Walk(room=1), Walk(room=1, mission=1), Walk(room=1, mission=2)]


@pytest.mark.parametrize("known", [0, 1, 2])
def test_all_missions_find_their_place_from_any_known_one(known):
    anchored, report = anchor_missions(scrambled(THREE, known=[known], seed=known))
    assert report.failure == ""
    assert len(report.anchored) == 2
    assert anchored.baseframes.is_known.all()
    error = yaw.from_pose(anchored.T_G_M)
    assert np.abs(error[:, :3]).max() < 0.03
    assert np.degrees(np.abs(error[:, 3]).max()) < 0.3


def test_only_base_frames_of_anchored_missions_change():
    vi_map = scrambled(THREE, known=[0], seed=4)
    anchored, _ = anchor_missions(vi_map)
    assert anchored.vertices is vi_map.vertices
    assert anchored.landmarks is vi_map.landmarks
    np.testing.assert_array_equal(anchored.T_G_M[0], vi_map.T_G_M[0])


def test_a_mission_of_another_place_stays_unknown_with_a_reason():
    vi_map = scrambled([*THREE, Walk(room=9, mission=3)], known=[0], seed=5)
    anchored, report = anchor_missions(vi_map)
    assert anchored.baseframes.is_known.tolist() == [True, True, True, False]
    np.testing.assert_array_equal(anchored.T_G_M[3], vi_map.T_G_M[3])
    assert len(report.not_anchored) == 1
    assert "no verified closure" in report.failure


def test_a_chain_of_missions_is_followed():
    # 0 and 2 have no room in common, 1 was in both
    walks = [
        Walk(room=1),
        Walk(room=1, mission=1),
        Walk(room=2, mission=1, start_s=30.0, room_at=(0.0, 8.0, 0.0)),
        Walk(room=2, mission=2, room_at=(0.0, 8.0, 0.0)),
    ]
    anchored, report = anchor_missions(scrambled(walks, known=[0], seed=6))
    assert report.failure == ""
    assert np.abs(yaw.from_pose(anchored.T_G_M)).max() < 0.1


def test_one_mission_alone_leaves_the_others():
    vi_map = scrambled(THREE, known=[0], seed=7)
    anchored, report = anchor_missions(vi_map, missions=np.array([2]))
    assert anchored.baseframes.is_known.tolist() == [True, False, True]
    assert len(report.anchored) == 1


def test_without_a_known_mission_the_remedy_is_named():
    _, report = anchor_missions(scrambled(THREE, known=[], seed=8))
    assert "set_mission_baseframe_to_known" in report.failure


def test_nothing_to_anchor_is_no_failure():
    vi_map, _ = make_map(THREE)
    same, report = anchor_missions(vi_map)
    assert same is vi_map
    assert report.failure == ""
    assert "known already" in report.notes[0]


def with_markers(vi_map, mission, *, wrong=0, sigma_rad=0.01):
    """Return the map with an absolute pose at every vertex of a mission, some of them 20 m off."""
    rows = np.flatnonzero(vi_map.vertices.mission == mission)
    T_G_S = np.array(vi_map.vertices.T_M_I[rows])  # missions are drawn where G is
    T_G_S[:wrong, 4:] += 20.0
    sigma = np.array([0.05, 0.05, 0.05, *[sigma_rad] * 3])
    poses = AbsolutePoses.filled(
        len(rows),
        vertex=rows,
        timestamp_ns=vi_map.vertices.timestamp_ns[rows],
        T_G_S=T_G_S,
        covariance=np.tile(np.diag(sigma**2), (len(rows), 1, 1)),
    )
    return vi_map.replace(absolute_poses=poses)


def test_missions_with_absolute_poses_come_first():
    vi_map = with_markers(scrambled(THREE, known=[], seed=10), 1, wrong=3)
    anchored, report = anchor_missions(vi_map)
    assert report.failure == ""
    assert report.by_absolute_poses == report.anchored[:1] == (to_hex(vi_map.missions.id[1])[:8],)
    assert anchored.baseframes.is_known.all()
    error = yaw.from_pose(anchored.T_G_M)
    assert np.abs(error[1]).max() < 5e-3
    assert np.abs(error[:, :3]).max() < 0.03
    # a known mission elsewhere does not hinder it, and stays where it is
    vi_map = with_markers(scrambled(THREE[:2], known=[0], seed=11), 1)
    anchored, report = anchor_missions(vi_map, missions=np.array([1]))
    assert len(report.already_known) == 1
    np.testing.assert_array_equal(anchored.T_G_M[0], vi_map.T_G_M[0])


def test_absolute_poses_that_disagree_anchor_nothing():
    few = AbsoluteAnchoringOptions(min_number_of_constraints=13)
    turned = with_markers(scrambled(THREE[:1], known=[], seed=12), 0)
    q = so3.multiply(so3.exp([0.0, 0.0, 0.5]), turned.absolute_poses.T_G_S[:, :4])
    T_G_S = se3.make(q, turned.absolute_poses.T_G_S[:, 4:])
    turned = turned.replace(absolute_poses=turned.absolute_poses.replace(T_G_S=T_G_S))
    for vi_map, options, message in (
        (
            with_markers(scrambled(THREE[:1], known=[], seed=12), 0),
            few,
            "min_number_of_constraints=13",
        ),
        (turned, AbsoluteAnchoringOptions(), "0 of 12 absolute poses agree"),
    ):
        same, report = anchor_missions(vi_map, absolute=options)
        assert same is vi_map
        assert message in report.notes[0]
        assert "set_mission_baseframe_to_known" in report.failure
    # orientations that were not measured do not count
    loose = turned.absolute_poses.replace(
        covariance=np.tile(np.diag([0.01] * 3 + [1e6] * 3), (12, 1, 1))
    )
    anchored, report = anchor_missions(turned.replace(absolute_poses=loose))
    assert len(report.by_absolute_poses) == 1
    assert np.abs(yaw.from_pose(anchored.T_G_M)).max() < 1e-3


def test_missions_that_are_anchored_need_not_anchor_others():
    walks = [
        Walk(room=1),
        Walk(room=1, mission=1),
        Walk(room=2, mission=1, start_s=30.0, room_at=(0.0, 8.0, 0.0)),
        Walk(room=2, mission=2, room_at=(0.0, 8.0, 0.0)),
    ]
    vi_map = scrambled(walks, known=[0], seed=6)
    anchored, report = anchor_missions(vi_map, AnchoringOptions(add_to_database=False))
    assert anchored.baseframes.is_known.tolist() == [True, True, False]
    assert len(report.not_anchored) == 1


def test_order_of_missions_does_not_matter():
    for order in ([0, 1, 2], [2, 1, 0]):
        walks = [Walk(room=1, mission=m, drift=(0.3 * m, 0.0, 0.0, 0.1 * m)) for m in order]
        walks.sort(key=lambda walk: walk.mission)
        anchored, _ = anchor_missions(scrambled(walks, known=[0], seed=9))
        expected = yaw.inverse(np.array([[0.3 * m, 0.0, 0.0, 0.1 * m] for m in range(3)]))
        np.testing.assert_allclose(yaw.from_pose(anchored.T_G_M), expected, atol=0.03)
