"""Ctrl-C while a command runs."""

from __future__ import annotations

import os
import signal
import time

import pytest

from maplab_py.console.command import describe
from maplab_py.console.output import ConsoleTerminal
from maplab_py.console.registry import Plugin
from maplab_py.console.runner import Runner
from maplab_py.console.session import Session
from maplab_py.console.status import Status
from maplab_py.plugin import CommandContext, Message
from tests.console.sample_plugin import make_registry, map_of


def press_ctrl_c() -> None:
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.01)


def stubborn(context: CommandContext, *, commits: bool = True) -> Message:
    """Never look whether to stop."""
    if commits:
        context.commit(map_of(9))
    press_ctrl_c()
    return Message("finished")


def patient(context: CommandContext) -> Message:
    """Look whether to stop after two interrupts."""
    context.commit(map_of(9))
    press_ctrl_c()
    press_ctrl_c()
    context.progress.check()
    return Message("never reached")


def swallowing(context: CommandContext) -> Message:
    """Catch KeyboardInterrupt as native code does; the wish to stop survives it."""
    try:
        press_ctrl_c()
    except KeyboardInterrupt:
        return Message("the handler raised")
    context.progress.step(1, 2, "half")
    return Message("never reached")


@pytest.fixture
def runner() -> Runner:
    registry = make_registry()
    for function in (stubborn, patient, swallowing):
        command = describe(function, function.__name__, ())
        registry.add(command, Plugin("interrupting"))
    terminal = ConsoleTerminal()
    runner = Runner(Session(registry, terminal), terminal)
    runner.session.maps.add("a", map_of(1))
    return runner


@pytest.mark.parametrize("command", ["stubborn", "patient", "swallowing"])
def test_a_cancelled_command_leaves_the_map_and_stops_the_script(
    runner: Runner, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    before = runner.session.maps.state
    handler = signal.getsignal(signal.SIGINT)
    assert runner.run_text(f"{command}; echo next", keep_going=True) == Status.CANCELLED
    out, err = capsys.readouterr()
    assert runner.session.maps.state is before
    assert signal.getsignal(signal.SIGINT) is handler
    assert "next" not in out
    assert "cancelled; the maps are as before" in err
    assert ("still runs" in err) == (command == "patient")


def test_what_has_finished_without_changing_a_map_keeps_its_result(runner: Runner) -> None:
    assert runner.run_text("stubborn --nocommits") == Status.OK
    assert runner.run_text("echo the next command is not cancelled") == Status.OK
