"""The loop around the prompt."""

from __future__ import annotations

from pathlib import Path

import pytest
from prompt_toolkit.application import create_app_session
from prompt_toolkit.input import create_pipe_input
from prompt_toolkit.output import DummyOutput

from maplab_py.console.output import ConsoleTerminal
from maplab_py.console.prompt import run_prompt
from maplab_py.console.runner import Runner
from maplab_py.console.session import Session
from maplab_py.console.status import Status
from tests.console.sample_plugin import make_registry


def test_an_interrupt_between_commands_brings_the_prompt_back(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    terminal = ConsoleTerminal()
    runner = Runner(Session(make_registry(), terminal), terminal)
    run_text, lines = runner.run_text, []

    def interrupted_once(text: str, *, keep_going: bool = False) -> Status:
        lines.append(text)
        if len(lines) == 1:
            raise KeyboardInterrupt
        return run_text(text, keep_going=keep_going)

    monkeypatch.setattr(runner, "run_text", interrupted_once)
    with create_pipe_input() as keys, create_app_session(input=keys, output=DummyOutput()):
        keys.send_text("echo one\necho two\nquit\n")
        assert run_prompt(runner) == Status.OK
    assert lines == ["echo one", "echo two", "quit"]
    out, err = capsys.readouterr()
    assert "two" in out
    assert "one" not in out
    assert "cancelled" in err
