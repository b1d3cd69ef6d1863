"""The prompt: its first lines, its history file, and the loop around it."""

import os
import shutil
import signal
from pathlib import Path
from typing import Any

import pytest
from prompt_toolkit import PromptSession
from prompt_toolkit.application import create_app_session
from prompt_toolkit.history import InMemoryHistory
from prompt_toolkit.input import create_pipe_input
from prompt_toolkit.output import DummyOutput

from maplab_py.console.prompt.loop import greeting, open_history, run_prompt
from maplab_py.console.scripts.runner import Runner
from maplab_py.console.session.paths import remember_maps
from maplab_py.console.session.session import Session
from maplab_py.console.session.status import Status
from maplab_py.console.terminal.output import ConsoleTerminal
from tests.console.sample_plugin import make_registry


def _map_at(folder: Path) -> None:
    (folder / "vi_map").mkdir(parents=True, exist_ok=True)
    (folder / "vi_map" / "vi_map_metadata").touch()


def test_it_names_the_version_the_way_to_help_and_the_maps_that_were_used_last(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.chdir(tmp_path)
    (line,) = greeting()
    assert line.startswith("maplab-py ")
    assert "help" in line
    for name in ("d", "a", "b c", "a", "gone"):
        _map_at(Path(name))
        remember_maps([Path(name)])
    (tmp_path / "gone" / "vi_map" / "vi_map_metadata").unlink()
    assert greeting()[1:] == ["recent maps:", "  load a", "  load 'b c'", "  load d"]
    monkeypatch.chdir(tmp_path / "a")
    assert greeting()[3] == f"  load '{tmp_path}/b c'"
    (tmp_path / "state" / "maplab" / "recent_maps").write_bytes(b"\xff\n\0\n")
    assert len(greeting()) == 1


def test_lines_of_two_consoles_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "state" / "history"
    first, second = (open_history(path)[0] for _ in range(2))
    first.append_string("load maps/office")
    second.append_string("elq\nrbl")
    first.append_string("save")
    kept = list(open_history(path)[0].load_history_strings())
    assert kept == ["save", "elq\nrbl", "load maps/office"]


def test_a_line_that_cannot_be_kept_is_still_in_memory(tmp_path: Path) -> None:
    path = tmp_path / "state" / "history"
    history, problem = open_history(path)
    assert problem == ""
    shutil.rmtree(path.parent)
    history.append_string("elq")
    assert history.get_strings() == ["elq"]
    assert not path.exists()


def test_without_a_file_there_is_a_history_in_memory(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    history, problem = open_history(tmp_path / "file" / "history")
    assert isinstance(history, InMemoryHistory)
    assert "file" in problem


@pytest.fixture
def runner(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Runner:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    terminal = ConsoleTerminal()
    return Runner(Session(make_registry(), terminal), terminal)


def typed(runner: Runner, text: str) -> Status:
    with create_pipe_input() as keys, create_app_session(input=keys, output=DummyOutput()):
        keys.send_text(text)
        return run_prompt(runner)


@pytest.mark.parametrize("is_before", [True, False])
def test_ctrl_c_between_commands_raises_nothing(
    runner: Runner,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    is_before: bool,
) -> None:
    """Right behind Enter it cancels the command, behind the command it cancels nothing."""
    run_text, lines = runner.run_text, []

    def interrupted_once(text: str, *, keep_going: bool = False) -> Status:
        lines.append(text)
        if is_before and len(lines) == 1:
            os.kill(os.getpid(), signal.SIGINT)
        status = run_text(text, keep_going=keep_going)
        if not is_before and len(lines) == 1:
            os.kill(os.getpid(), signal.SIGINT)
        return status

    monkeypatch.setattr(runner, "run_text", interrupted_once)
    before = signal.getsignal(signal.SIGINT)
    assert typed(runner, "echo one\necho two\nquit\n") == Status.OK
    assert signal.getsignal(signal.SIGINT) is before
    assert lines == ["echo one", "echo two", "quit"]
    out, err = capsys.readouterr()
    assert "two" in out
    assert err.count("echo: cancelled; the maps are as before") == is_before
    assert "KeyboardInterrupt" not in err


def test_ctrl_c_while_the_prompt_is_drawn_draws_another(
    runner: Runner, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The line discipline of the terminal has dropped what was typed before."""
    drawn = []

    read = PromptSession.prompt

    def interrupted_read(self: PromptSession[str], *arguments: Any) -> str:
        drawn.append(len(drawn))
        if len(drawn) == 1:
            os.kill(os.getpid(), signal.SIGINT)
        return read(self, *arguments)

    monkeypatch.setattr(PromptSession, "prompt", interrupted_read)
    assert typed(runner, "echo one\nquit\n") == Status.OK
    assert drawn == [0, 1, 2]
    out, err = capsys.readouterr()
    assert "one" in out
    assert "cancelled" not in err


def test_ctrl_c_typed_ahead_behind_enter_cancels_the_command(
    runner: Runner, capsys: pytest.CaptureFixture[str]
) -> None:
    assert typed(runner, "echo one\nlost\x03echo two\nquit\n") == Status.OK
    out, err = capsys.readouterr()
    assert "two" in out
    assert "one" not in out
    assert "lost" not in out + err
    assert err.count("echo: cancelled; the maps are as before") == 1


def test_an_interrupt_between_commands_brings_the_prompt_back(
    runner: Runner, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run_text, lines = runner.run_text, []

    def interrupted_once(text: str, *, keep_going: bool = False) -> Status:
        lines.append(text)
        if len(lines) == 1:
            raise KeyboardInterrupt
        return run_text(text, keep_going=keep_going)

    monkeypatch.setattr(runner, "run_text", interrupted_once)
    assert typed(runner, "echo one\necho two\nquit\n") == Status.OK
    assert lines == ["echo one", "echo two", "quit"]
    out, err = capsys.readouterr()
    assert "two" in out
    assert "one" not in out
    assert "cancelled" in err
