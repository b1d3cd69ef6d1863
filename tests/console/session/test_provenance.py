"""The commands that led to a map can be written as a script that makes the same map."""

from __future__ import annotations

from pathlib import Path

import pytest

from maplab_py.console.commands.registry import load_registry
from maplab_py.console.scripts.runner import Runner
from maplab_py.console.session.session import Session
from maplab_py.console.session.status import Status
from maplab_py.console.terminal.output import ConsoleTerminal
from maplab_py.errors import UserError
from maplab_py.storage.native import save_map
from maplab_py.vimap.comparison import is_same
from tests.console.sample_plugin import map_of
from tests.vimap.builders import walk_map


@pytest.fixture
def session(tmp_path: Path) -> Session:
    for number in range(3):
        save_map(walk_map(seed=number), tmp_path / f"walk {number}")
    return Session(load_registry())


def run(session: Session, *lines: str) -> None:
    runner = Runner(session, ConsoleTerminal())
    assert runner.run_text("\n".join(lines)) == Status.OK


def script_of(session: Session) -> list[str]:
    return list(session.run("history", as_script=True).as_dict()["commands"])


def test_the_script_makes_the_same_map_in_a_new_session(session: Session, tmp_path: Path) -> None:
    run(
        session,
        f"load '{tmp_path}/walk 0' --map_key=first",
        "elq --elq_min_observers=50",
        f"load '{tmp_path}/walk 1' --map_key=second",
        "set elq_min_observers=60",
        "elq",
        "set_all_mission_baseframes_to_known",
        "undo",
        "select_map first",
        "sbk",
        "merge_map second",
        "rename_mission monday --map_mission=walk\\ 0",
        "snapshot merged",
        "remove_mission --map_mission=monday --yes",
        "restore merged",
    )
    script = script_of(session)
    again = Session(load_registry())
    run(again, *script)
    assert is_same(again.vi_map, session.vi_map)
    assert not any(line.startswith(("undo", "restore", "remove_mission")) for line in script)
    assert "select_map first" in script
    assert sum("--elq_min_observers=60" in line for line in script) == 1


def test_undone_commands_are_shown_but_not_written(session: Session, tmp_path: Path) -> None:
    run(session, f"load '{tmp_path}/walk 0'", "sbk", "rename_mission monday", "undo")
    assert [line.split()[0] for line in script_of(session)] == [
        "load",
        "set_mission_baseframe_to_known",
    ]
    shown = session.run("history").as_dict()["commands"]
    assert [line["state"] for line in shown] == ["", "", "undone"]
    run(session, "redo")
    assert script_of(session)[-1] == "rename_mission --name=monday"


def test_a_renamed_map_and_a_dry_run(session: Session, tmp_path: Path) -> None:
    run(session, f"load '{tmp_path}/walk 0'", "rename_map office", "sbk --dry_run", "sbk")
    script = script_of(session)
    again = Session(load_registry())
    run(again, *script)
    assert is_same(again.vi_map, session.vi_map)
    assert [line.split()[0] for line in script] == [
        "load",
        "rename_map",
        "set_mission_baseframe_to_known",
    ]


def test_a_map_from_python_has_no_script(session: Session) -> None:
    session.maps.add("a", map_of(1))
    with pytest.raises(UserError, match="made from Python"):
        session.run("history")
