"""Chains of commands with a fault are not started, and every fault of them is named."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from maplab_py.console.commands.registry import load_registry
from maplab_py.console.scripts.checking import check_commands
from maplab_py.console.scripts.runner import Runner
from maplab_py.console.session.session import Session
from maplab_py.console.session.status import Status
from maplab_py.console.terminal.output import ConsoleTerminal
from tests.console.sample_plugin import map_of

REGISTRY = load_registry()


@pytest.fixture
def session() -> Session:
    return Session(REGISTRY)


FAULTS = {
    "optivi": "unknown command 'optivi'",
    "optvi --ba_num_iteration=3": "has no flag --ba_num_iteration",
    "optvi --ba_num_iterations=three": "wants a whole number",
    "evaluate_trajectory": "needs --ground_truth",
    "evaluate_trajectory --ground_truth=nosuch.csv": "there is no such file",
    "load nosuch": "there is no such file",
    "load $NO_SUCH_VARIABLE": "variable $NO_SUCH_VARIABLE is not set",
    "kfh word": "unexpected word 'word'",
    "optvi --flagfile=nosuch.flags": "nosuch.flags",
}


@pytest.mark.parametrize("place", ["first", "middle", "last"])
@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_anywhere_is_named_and_nothing_runs(
    fault: str, place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    sound = ["create_new_map a", "map_stats"]
    sound.insert({"first": 0, "middle": 1, "last": 2}[place], fault)
    runner = Runner(Session(REGISTRY), ConsoleTerminal())
    began = time.process_time()
    assert runner.run_script("; ".join(sound)) == Status.USER_ERROR
    assert time.process_time() - began < 0.5
    assert not len(runner.session.maps)
    column = "; ".join(sound).index(fault) + 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: column {column}: ")
    assert FAULTS[fault] in line


def test_all_faults_of_a_script_are_named_with_their_lines(session: Session) -> None:
    text = "map_stats\n# a remark\n  optivi; kfh --x=1\nlc --lc_min_inlier_count=many"
    problems = check_commands(text, session)
    assert [problem.split(":")[0] for problem in problems] == [
        "line 3, column 3", "line 3, column 11", "line 4, column 1",
    ]  # fmt: skip


SOUND = [
    "N=3; optvi --ba_num_iterations=$N",
    "set --ground_truth=nosuch.csv; evaluate_trajectory",
    "alias tidy='elq; rbl'; tidy --help; tidy",
    "save results; load results; load results/sub",
    "!make maps; load maps/a",
    "q; nonsense",
    "optvi --ba_num_iterations=3 &",
    "map_stats > stats.txt; map_stats | grep good",
    "help lc; lc --help",
    "simulate --map_folder=sim; load sim/session_1",
]


@pytest.mark.parametrize("text", SOUND)
def test_what_earlier_commands_make_is_there(
    text: str, session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    if text.startswith("set"):
        (tmp_path / "nosuch.csv").touch()
    assert check_commands(text, session) == []


def test_checking_leaves_the_session_as_it_is(session: Session) -> None:
    check_commands("X=1; alias tidy='elq'; set --ba_num_iterations=3", session)
    assert session.variables == {}
    assert session.aliases == {}
    assert session.settings.current() == {}


def test_an_alias_in_a_circle_is_a_fault(session: Session) -> None:
    (problem,) = check_commands("alias a='a b'; a", session)
    assert "contains itself" in problem or "refers to itself" in problem


def test_with_keep_going_sound_commands_run(capsys: pytest.CaptureFixture[str]) -> None:
    runner = Runner(Session(REGISTRY), ConsoleTerminal())
    assert runner.run_script("nonsense; create_new_map a", keep_going=True) == Status.USER_ERROR
    assert runner.session.maps.keys == ["a"]


def test_what_a_failed_script_made_is_recovered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    runner = Runner(Session(REGISTRY), ConsoleTerminal())
    runner.session.maps.add("a", map_of(1))
    made = runner.session.vi_map
    assert runner.finish(runner.run_script("restore nothing"), discard=False) == Status.USER_ERROR
    assert "maplab recover" in capsys.readouterr().err
    again = Session(REGISTRY)
    again.run("recover")
    assert again.maps.keys == ["a"]
    assert again.vi_map.missions.id.tolist() == made.missions.id.tolist()
    assert [entry.key for entry in again.maps.unsaved] == ["a"]
    for _ in range(7):
        assert runner.finish(discard=False) in (Status.OK, Status.USER_ERROR)
    assert len(list((tmp_path / "maplab" / "rescued").iterdir())) <= 5
