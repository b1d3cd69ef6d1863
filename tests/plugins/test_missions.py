"""Removal of missions and the state of base frames."""

from __future__ import annotations

import pytest

from maplab_py.console.session.session import Session
from maplab_py.errors import UserError
from tests.console.sample_plugin import map_of


@pytest.fixture
def session() -> Session:
    session = Session()
    session.maps.add("a", map_of(3))
    return session


def known(session: Session) -> list[bool]:
    vi_map = session.vi_map
    return [bool(k) for k in vi_map.baseframes.is_known[vi_map.missions.baseframe]]


def test_one_base_frame_by_prefix_and_the_first_without(session: Session) -> None:
    session.run("sbk", map_mission="2")
    assert known(session) == [False, True, False]
    report = session.run("set_mission_baseframe_to_known")
    assert known(session) == [True, True, False]
    assert "1000" in report.text  # type: ignore[attr-defined]
    session.run("set_mission_baseframe_to_unknown", map_mission="2")
    assert known(session) == [True, False, False]


def test_all_base_frames(session: Session) -> None:
    session.run("set_all_mission_baseframes_to_known")
    assert known(session) == [True] * 3
    session.run("sabu")
    assert known(session) == [False] * 3


@pytest.mark.parametrize("command", ["sbk", "set_mission_baseframe_to_unknown", "rm"])
def test_a_wrong_mission_is_an_error_and_not_the_first_one(session: Session, command: str) -> None:
    before = session.vi_map
    with pytest.raises(UserError, match="no mission begins with 'f00'"):
        session.run(command, map_mission="f00")
    assert session.vi_map is before


def test_remove_missions(session: Session) -> None:
    with pytest.raises(UserError, match="no mission is given"):
        session.run("remove_mission")
    with pytest.raises(UserError, match="--yes"):
        session.run("remove_mission", map_mission="1")
    session.run("remove_mission", map_mission_list="1,3", yes=True)
    assert len(session.vi_map.missions) == 1
    session.run("undo")
    assert len(session.vi_map.missions) == 3


def test_a_mission_is_renamed_and_found_by_its_name(session: Session) -> None:
    report = session.run("rename_mission", "monday", map_mission="2")
    assert report.text.endswith("to 'monday'")  # type: ignore[attr-defined]
    assert list(session.vi_map.missions.name) == ["", "monday", ""]
    session.run("sbk", map_mission="mon")
    assert known(session) == [False, True, False]
    session.run("undo")
    session.run("undo")
    assert list(session.vi_map.missions.name) == ["", "", ""]


def test_wrong_names(session: Session) -> None:
    session.run("rename_mission", "monday", map_mission="2")
    with pytest.raises(UserError, match="another mission is named 'monday'"):
        session.run("rename_mission", "monday", map_mission="1")
    with pytest.raises(UserError, match="cannot be a name"):
        session.run("rename_mission", "a,b", map_mission="1")
    with pytest.raises(UserError, match="--map_mission is empty"):
        session.run("rename_mission", "tuesday")
    with pytest.raises(UserError, match=r"no mission begins with 'wed'.*monday \(2000\)"):
        session.run("sbk", map_mission="wed")


def test_map_stats_has_a_row_for_each_mission_and_details_of_a_chosen_one(
    session: Session,
) -> None:
    session.run("rename_mission", "monday", map_mission="2")
    table = session.run("map_stats").display()
    assert [line.mission for line in table.missions][1] == "monday"
    assert all(line.closures == 0 for line in table.missions)
    assert table.summary.startswith("3 missions: ")
    details = session.run("map_stats", map_mission="monday")
    assert details.display() is details
    assert [mission["name"] for mission in details.as_dict()["missions"]] == ["monday"]
