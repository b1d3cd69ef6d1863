"""The anchoring commands, through the session."""

from __future__ import annotations

import numpy as np
import pytest

from maplab_py.console.registry import load_registry
from maplab_py.console.session import Session
from maplab_py.errors import UserError
from maplab_py.vimap.ids import to_hex
from tests.algorithms.loop_closure.rooms import Walk, make_map

WALKS = [Walk(room=1), Walk(room=1, mission=1), Walk(room=1, mission=2)]


def session_of(*, known: list[bool]) -> Session:
    vi_map = make_map(WALKS)[0]
    T_G_M = vi_map.baseframes.T_G_M + np.where(known, 0.0, 5.0)[:, None] * np.eye(7)[5]
    frames = vi_map.baseframes.replace(T_G_M=T_G_M, is_known=np.array(known))
    session = Session(load_registry())
    session.maps.add("rooms", vi_map.replace(baseframes=frames))
    return session


def test_all_missions_are_anchored() -> None:
    session = session_of(known=[True, False, False])
    report = session.run("aam")
    assert report.failure == ""
    assert session.vi_map.baseframes.is_known.all()
    assert np.abs(session.vi_map.T_G_M[:, 4:]).max() < 0.03


def test_one_mission_is_anchored() -> None:
    session = session_of(known=[True, False, False])
    name = to_hex(session.vi_map.missions.id[2])
    report = session.run("am", map_mission=name[:8])
    assert report.anchored == (name[:8],)
    assert session.vi_map.baseframes.is_known.tolist() == [True, False, True]
    with pytest.raises(UserError):
        session.run("am", map_mission="xyz")


def test_without_a_known_mission_it_fails() -> None:
    session = session_of(known=[False, False, False])
    assert "set_mission_baseframe_to_known" in session.run("aam").failure


def test_thresholds_are_flags() -> None:
    session = session_of(known=[True, False, False])
    report = session.run("aam", anchor_transform_min_inlier_count=1000)
    assert "1000 are wanted" in report.failure
    assert session.vi_map.baseframes.is_known.tolist() == [True, False, False]
