"""Ctrl-C while a command runs, questions from it, and commands that do not stop."""

from __future__ import annotations

import io
import os
import signal
import threading
import time

import pytest

from maplab_py.console.cancellation import check_cancelled
from maplab_py.console.command import describe
from maplab_py.console.foreground import in_waiting_thread, run_in_foreground
from maplab_py.console.output import ConsoleTerminal
from maplab_py.console.registry import Plugin
from maplab_py.console.runner import Runner
from maplab_py.console.session import Session
from maplab_py.console.status import Status
from maplab_py.errors import Cancelled
from maplab_py.plugin import CommandContext, Message
from tests.console.sample_plugin import make_registry, map_of
from tests.support.machine import slowness

END = threading.Event()


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


def endless(context: CommandContext) -> Message:
    """Work on long after Ctrl-C, as one call of native code does, and commit at last."""
    press_ctrl_c()
    END.wait(20)
    context.commit(map_of(9))
    context.maps.add("late", map_of(1))
    return Message("finished too late")


def writing(context: CommandContext) -> Message:
    """Write files for longer than the console waits for other commands."""
    press_ctrl_c()
    time.sleep(1.2)
    return Message("written")


@pytest.fixture
def runner() -> Runner:
    registry = make_registry()
    for function in (stubborn, patient, swallowing, endless, writing):
        command = describe(function, function.__name__, (), acts_outside=function is writing)
        registry.add(command, Plugin("interrupting"))
    terminal = ConsoleTerminal()
    runner = Runner(Session(registry, terminal), terminal)
    runner.session.maps.add("a", map_of(1))
    END.clear()
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


def test_a_command_that_does_not_stop_is_left_behind_and_reaches_nobody(runner: Runner) -> None:
    before = runner.session.maps.state
    start = time.monotonic()
    assert runner.run_text("endless") == Status.CANCELLED
    assert time.monotonic() - start < 1.0 * slowness()
    assert runner.run_text("echo the session goes on") == Status.OK
    END.set()
    (thread,) = [t for t in threading.enumerate() if t.name == "command endless"]
    thread.join(10)
    assert runner.session.maps.state is before


def test_a_command_that_writes_files_is_waited_for(
    runner: Runner, capsys: pytest.CaptureFixture[str]
) -> None:
    assert runner.run_text("writing") == Status.OK
    assert "written" in capsys.readouterr().out


def test_questions_are_asked_in_the_waiting_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    asked_in = []

    def ask() -> str:
        asked_in.append(threading.current_thread())
        return "yes"

    assert run_in_foreground("asking", lambda: in_waiting_thread(ask)) == "yes"
    assert asked_in == [threading.main_thread()]
    assert in_waiting_thread(ask) == "yes"


def test_ctrl_c_at_a_question_cancels(runner: Runner, monkeypatch: pytest.MonkeyPatch) -> None:
    class Keyboard(io.StringIO):
        def readline(self, *arguments: int) -> str:
            press_ctrl_c()
            return "y"

    monkeypatch.setattr(ConsoleTerminal, "is_interactive", property(lambda self: True))
    monkeypatch.setattr("sys.stdin", Keyboard())
    assert runner.run_text("destroy") == Status.CANCELLED
    assert runner.run_text("echo on") == Status.OK


def test_errors_reach_the_caller() -> None:
    def fail() -> None:
        raise ZeroDivisionError("as it was")

    with pytest.raises(ZeroDivisionError, match="as it was"):
        run_in_foreground("failing", fail)


def test_inside_a_command_another_runs_under_the_same_token() -> None:
    def outer() -> None:
        press_ctrl_c()
        run_in_foreground("inner", check_cancelled)

    with pytest.raises(Cancelled):
        run_in_foreground("outer", outer)
    check_cancelled()
