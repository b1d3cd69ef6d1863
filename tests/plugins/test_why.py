"""`why`: what its argument names, and what it answers."""

from __future__ import annotations

import pytest

from maplab_py.algorithms.landmarks.quality import LandmarkExplanation
from maplab_py.algorithms.loop_closure.closure_record import read_record
from maplab_py.algorithms.loop_closure.explanation import (
    ClosureExplanation,
    MissionExplanation,
    PairExplanation,
)
from maplab_py.console.commands.registry import load_registry
from maplab_py.console.prompt.completion import complete
from maplab_py.console.session.session import Session
from maplab_py.errors import UserError
from maplab_py.vimap.ids import to_hex
from tests.algorithms.loop_closure.rooms import Walk, make_map

WALKS = [Walk(room=1), Walk(room=1, mission=1, start_s=60.0, drift=(0.2, -0.1, 0.05, 0.01))]


@pytest.fixture(scope="module")
def session() -> Session:
    session = Session(load_registry())
    session.maps.add("rooms", make_map(WALKS)[0])
    first, second = (to_hex(words) for words in session.vi_map.missions.id)
    session.run("rename_mission", "monday", map_mission=first)
    session.run("rename_mission", "tuesday", map_mission=second)
    session.run("lc", lc_min_inlier_count=1000)
    return session


def test_the_argument_is_resolved(session: Session) -> None:
    closure = to_hex(read_record(session.vi_map).closures.id[0])[:8]
    landmark = to_hex(session.vi_map.landmarks.id[3])
    assert isinstance(session.run("why", closure), ClosureExplanation)
    assert isinstance(session.run("why", "monday"), MissionExplanation)
    assert isinstance(session.run("why", "tue"), MissionExplanation)
    assert isinstance(session.run("why", "monday", "tuesday"), PairExplanation)
    assert isinstance(session.run("why", landmark), LandmarkExplanation)


def test_flags_show_what_they_would_decide(session: Session) -> None:
    closure = to_hex(read_record(session.vi_map).closures.id[0])[:8]
    strict = session.run("why", closure, lc_min_inlier_count=1000)
    assert [line["flag"] for line in strict.as_dict()["gates"] if line["result"] == "failed"] == [
        "--lc_min_inlier_count"
    ]
    usual = session.run("why", closure)
    assert "would pass" in usual.as_dict()["summary"]


def test_wrong_arguments(session: Session) -> None:
    with pytest.raises(UserError, match="no closure, mission or landmark begins with 'xyz'"):
        session.run("why", "xyz")
    with pytest.raises(UserError, match="two different missions"):
        session.run("why", "monday", "monday")
    with pytest.raises(UserError, match="no mission begins with 'sunday'"):
        session.run("why", "monday", "sunday")
    with pytest.raises(UserError, match="no closure, mission or landmark"):
        session.run("why", "")


def test_missions_and_closures_are_completed(session: Session) -> None:
    candidates = complete("why ", session)
    assert {"monday", "tuesday"} <= {candidate.text for candidate in candidates}
    assert any("too few inliers" in candidate.help for candidate in candidates)
    assert [c.text for c in complete("why monday tu", session)] == ["tuesday"]
