"""The terminal while a command runs: foreground, pager, progress, questions."""

import io
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from io import TextIOWrapper
from pathlib import Path

import pyte
import pytest

from maplab_py import kernel_cache
from maplab_py.cancellation import check_cancelled, current_token, ending_early, lasting_effect
from maplab_py.console.commands.command import describe
from maplab_py.console.commands.registry import Plugin
from maplab_py.console.scripts.runner import Runner
from maplab_py.console.session.session import Session
from maplab_py.console.session.status import Status
from maplab_py.console.terminal import output
from maplab_py.console.terminal.foreground import (
    SECONDS_OF_GRACE,
    cancelling_interrupts,
    in_waiting_thread,
    run_in_foreground,
)
from maplab_py.console.terminal.output import SECONDS_BEFORE_BAR, ConsoleTerminal, TerminalProgress
from maplab_py.console.terminal.protocol import SilentTerminal
from maplab_py.errors import Cancelled, UserError
from maplab_py.plugin import CommandContext, Message, write_text
from tests.console.sample_plugin import make_registry, map_of
from tests.support.machine import slowness
from tests.support.waiting import wait_until

END = threading.Event()
LONG_S = 2.0 * SECONDS_OF_GRACE
"""Longer than the console waits for a command that does not stop."""


def press_ctrl_c() -> None:
    """Press it, and wait until the console has heard it."""
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.01)  # nothing tells that a second press was heard
    if in_command():
        wait_until(lambda: current_token().cancelled, 5.0)


def in_command() -> bool:
    return threading.current_thread() is not threading.main_thread()


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
    time.sleep(LONG_S)
    return Message("written")


def exporting(context: CommandContext, *, first: bool = False) -> Message:
    """Write two files, long after Ctrl-C or one of them before."""
    if first:
        write_text(Path("new/first"), ["1"])
    press_ctrl_c()
    END.wait(20)
    write_text(Path("new/second"), ["2"])
    return Message("finished too late")


def removing(context: CommandContext) -> Message:
    """Act outside in a guarded way, long after Ctrl-C."""
    press_ctrl_c()
    END.wait(20)
    with lasting_effect():
        Path("old").unlink()
    return Message("finished too late")


def replacing(context: CommandContext) -> Message:
    """Be inside an effect for longer than the console waits for other commands."""
    with lasting_effect():
        press_ctrl_c()
        time.sleep(LONG_S)
    return Message("written")


def recording(context: CommandContext, *, presses: int = 1) -> Message:
    """Read an endless recording until the user ends it."""
    context.commit(map_of(9))
    with ending_early() as is_to_end:
        os.kill(os.getpid(), signal.SIGINT)
        assert wait_until(is_to_end, 5.0)
        context.progress.check()
        if presses > 1:
            press_ctrl_c()
            context.progress.check()
    return Message("finished with what there is")


def failing_late(context: CommandContext) -> Message:
    """Write a file, then fail."""
    write_text(Path("new/first"), ["1"])
    raise UserError("as was asked")


@pytest.fixture
def runner() -> Runner:
    registry = make_registry()
    for function in (exporting, failing_late):
        command = describe(function, function.__name__, (), writes_files=True)
        registry.add(command, Plugin("exporting"))
    for function in (removing, replacing):
        command = describe(function, function.__name__, (), acts_outside=True, guards_effects=True)
        registry.add(command, Plugin("guarding"))
    for function in (stubborn, patient, swallowing, endless, recording, writing):
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
    assert ("is still running" in err) == (command == "patient")


def test_ctrl_c_cancels_also_what_changes_nothing_and_stops_the_script(runner: Runner) -> None:
    assert runner.run_text("stubborn --nocommits; echo next") == Status.CANCELLED
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


def test_the_first_ctrl_c_ends_a_recording_and_its_result_counts(
    runner: Runner, capsys: pytest.CaptureFixture[str]
) -> None:
    assert runner.run_text("recording; echo next") == Status.OK
    out, err = capsys.readouterr()
    assert "finished with what there is" in out
    assert "next" in out
    assert "Ctrl-C again cancels it" in err
    assert len(runner.session.vi_map.missions) == 9


def test_the_second_ctrl_c_cancels_a_recording(
    runner: Runner, capsys: pytest.CaptureFixture[str]
) -> None:
    before = runner.session.maps.state
    assert runner.run_text("recording --presses=2; echo next") == Status.CANCELLED
    out, err = capsys.readouterr()
    assert "next" not in out
    assert "cancelled; the maps are as before" in err
    assert runner.session.maps.state is before


@pytest.mark.parametrize("command", ["writing", "replacing"])
def test_an_effect_that_has_begun_is_waited_for(
    runner: Runner, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    assert runner.run_text(f"{command}; echo next") == Status.CANCELLED
    out, err = capsys.readouterr()
    assert "written" in out
    assert "next" not in out
    assert f"error: {command}: finished before Ctrl-C" in err


@pytest.mark.parametrize("command", ["exporting", "exporting --first", "removing"])
def test_a_command_that_was_left_behind_writes_nothing(
    runner: Runner, command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("old").write_text("old")
    start = time.monotonic()
    assert runner.run_text(command) == Status.CANCELLED
    assert time.monotonic() - start < 1.0 * slowness()
    assert [path.name for path in tmp_path.iterdir()] == ["old"]
    END.set()
    for thread in threading.enumerate():
        if thread.name == f"command {command.split(maxsplit=1)[0]}":
            thread.join(10)
    assert [path.name for path in tmp_path.iterdir()] == ["old"]


def test_a_command_that_fails_writes_none_of_its_files(
    runner: Runner, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert runner.run_text("failing_late") == Status.USER_ERROR
    assert list(tmp_path.iterdir()) == []


def test_a_cancelled_command_names_what_remains(
    runner: Runner, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    def halfway(context: CommandContext) -> Message:
        """Write a file, then hear Ctrl-C."""
        write_text(tmp_path / "a", ["written"])
        press_ctrl_c()
        context.progress.check()
        return Message("never reached")

    command = describe(halfway, "halfway", (), acts_outside=True, guards_effects=True)
    runner.session.registry.add(command, Plugin("half"))
    assert runner.run_text("halfway") == Status.CANCELLED
    assert "what it had done outside them remains" in capsys.readouterr().err


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


def test_inside_a_command_another_runs_under_the_same_token() -> None:
    def outer() -> None:
        press_ctrl_c()
        run_in_foreground("inner", check_cancelled)

    with pytest.raises(Cancelled):
        run_in_foreground("outer", outer)
    check_cancelled()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_an_interrupt_that_python_discards_still_cancels() -> None:
    class Finalised:
        def __del__(self) -> None:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.01)

    before = signal.getsignal(signal.SIGINT)
    with cancelling_interrupts():
        check_cancelled()
        finalised = Finalised()
        del finalised
        with pytest.raises(Cancelled):
            check_cancelled()
        with pytest.raises(KeyboardInterrupt):
            press_ctrl_c()
    check_cancelled()
    assert signal.getsignal(signal.SIGINT) is before


def test_an_interrupt_that_the_shell_has_let_be_ignored_cancels() -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with cancelling_interrupts(), pytest.raises(KeyboardInterrupt):
            press_ctrl_c()
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.fixture
def keyboard(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """Give the end of a pseudo-terminal at which the keys are typed."""
    typing_end, reading_end = os.openpty()
    with os.fdopen(reading_end, "r") as stdin:
        assert isinstance(stdin, TextIOWrapper)
        monkeypatch.setattr(sys, "stdin", stdin)
        yield typing_end
    os.close(typing_end)


@pytest.mark.parametrize("keys", [b"x", b"map_stats\r"])
def test_typed_keys_are_seen_and_left_to_be_read(keyboard: int, keys: bytes) -> None:
    assert not output.keys_are_waiting()
    os.write(keyboard, keys)
    assert wait_until(output.keys_are_waiting)
    if keys.endswith(b"\r"):
        assert sys.stdin.readline() == "map_stats\n"
    else:
        os.write(keyboard, b"\n")
        assert sys.stdin.readline() == "x\n"


def test_nothing_waits_where_there_is_no_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    with open(os.devnull) as null:
        monkeypatch.setattr(sys, "stdin", null)
        assert not output.keys_are_waiting()


class _Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def lines(width: int, what: str, total: float, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return what a terminal of some width shows of a bar at three tenths."""
    monkeypatch.setenv("COLUMNS", str(width))
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.delenv("NO_COLOR", raising=False)
    stream = _Terminal()
    progress = TerminalProgress(stream)
    progress._start -= 2 * SECONDS_BEFORE_BAR
    progress.step(0.3 * total, total, what)
    assert progress._bar is not None
    progress._bar.refresh()  # the next of ten a second
    screen = pyte.Screen(width, 6)
    pyte.Stream(screen).feed(stream.getvalue().replace("\n", "\r\n"))
    shown = [line.rstrip() for line in screen.display if line.strip()]
    progress.close()
    return shown


def test_a_command_that_waits_for_a_compilation_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.delenv("NO_COLOR", raising=False)
    stream = _Terminal()
    progress = TerminalProgress(stream, what="rovioli")
    progress._start -= 2 * SECONDS_BEFORE_BAR
    before_s = kernel_cache.seconds()
    with kernel_cache.compilation():
        kernel_cache.is_compiling.set()
        progress.tick()
        assert progress._bar is not None
        assert progress._bar.tasks[0].description == "compiling kernels, once"
    progress.tick()
    assert progress._bar.tasks[0].description == "rovioli"
    progress.close()
    assert kernel_cache.seconds() > before_s


@pytest.mark.parametrize("width", [60, 80, 120])
@pytest.mark.parametrize("total", [0.0, 20.0])
def test_a_long_step_is_cut_and_the_time_stays(
    width: int, total: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    what = "12.4 s  287 tracks  164 landmarks  21 ms (read 2, tracking 11, window 7, map 1)"
    (line,) = lines(width, what, total, monkeypatch)
    assert line.startswith(what[: width // 3])
    assert line.endswith("0:00:00 elapsed")
    assert ("…" in line) == (width < 120)


def test_a_short_step_is_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    (line,) = lines(80, "iteration 3 of at most 20", 20.0, monkeypatch)
    assert line.startswith("iteration 3 of at most 20 ━")
    assert "30%" in line


ANSWERS = ("yes", "no", "quit")


def choose(typed: str, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setattr("sys.stdin", io.StringIO(typed))
    return ConsoleTerminal().choose("remove?", ANSWERS)


@pytest.mark.parametrize(
    ("typed", "answer"), [("y\n", "yes"), ("No\n", "no"), (" quit \n", "quit"), ("q", "quit")]
)
def test_words_and_first_letters_are_answers(
    typed: str, answer: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert choose(typed, monkeypatch) == answer


def test_the_question_is_repeated_until_there_is_an_answer(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert choose("\nmaybe\nye\nn\n", monkeypatch) == "no"
    assert capsys.readouterr().err == "remove? [y/n/q] " * 4


def test_the_end_of_the_input_cancels(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(Cancelled, match="the input has ended"):
        choose("maybe\n", monkeypatch)
    with pytest.raises(UserError, match="nobody is there to answer"):
        SilentTerminal().choose("remove?", ANSWERS)
