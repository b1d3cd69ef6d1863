"""Commands in the background: one consistent value of the map, results that find their way."""

import threading
from typing import Any

import pytest

from maplab_py.cancellation import CancelToken, ending_early
from maplab_py.console.commands.command import describe
from maplab_py.console.commands.registry import Plugin
from maplab_py.console.scripts.runner import Runner
from maplab_py.console.session.maps import Conflict, MapManager, merge_states
from maplab_py.console.session.session import Session
from maplab_py.console.session.status import Status
from maplab_py.console.terminal.output import ConsoleTerminal
from maplab_py.errors import UserError
from maplab_py.plugin import CommandContext, Message
from maplab_py.vimap import VIMap
from tests.console.sample_plugin import make_registry, map_of
from tests.support.waiting import wait_until

Capture = pytest.CaptureFixture[str]


class Gate:
    """Lets a job go on when the test says so."""

    def __init__(self) -> None:
        self.reached = threading.Event()
        self.open = threading.Event()


@pytest.fixture
def gate() -> Gate:
    return Gate()


@pytest.fixture
def runner(gate: Gate) -> Runner:
    def slowly(context: CommandContext, *, missions: int = 5, fails: bool = False) -> Message:
        """Read the map, wait, read it again, then commit."""
        first = context.vi_map
        gate.reached.set()
        while not gate.open.wait(0.01):
            context.progress.step(1, 4, "waiting")
        if fails:
            raise UserError("as was asked")
        context.commit(map_of(missions))
        return Message("consistent" if context.maps.selected.vi_map is first else "torn")

    registry = make_registry()
    registry.add(describe(slowly, "slowly", ()), Plugin("slow"))
    terminal = ConsoleTerminal()
    runner = Runner(Session(registry, terminal), terminal)
    runner.session.maps.add("a", map_of(1))
    return runner


def missions(runner: Runner, key: str = "a") -> int:
    return len(runner.session.maps.get(key).vi_map.missions)


def test_a_job_sees_one_value_and_its_result_waits_for_join(
    runner: Runner, gate: Gate, capsys: Capture
) -> None:
    assert runner.run_text("slowly &; jobs") == Status.OK
    gate.reached.wait(10)
    assert "running" in capsys.readouterr().out
    gate.open.set()
    assert runner.run_text("join") == Status.OK
    assert "consistent" in capsys.readouterr().out
    assert missions(runner) == 5
    assert len(runner.session.maps.selected.undone().vi_map.missions) == 1
    assert runner.run_text("join") == Status.OK
    assert "no jobs to wait for" in capsys.readouterr().out


def test_a_map_that_was_edited_meanwhile_keeps_the_edit(
    runner: Runner, gate: Gate, capsys: Capture
) -> None:
    runner.run_text("slowly &")
    gate.reached.wait(10)
    runner.run_text("add_mission")
    gate.open.set()
    assert runner.run_text("join 1") == Status.OK
    out = capsys.readouterr().out
    assert "consistent" in out
    assert "the result of job 1 is map 'a-1'" in out
    assert (missions(runner), missions(runner, "a-1")) == (2, 5)
    assert not runner.session.maps.get("a-1").is_saved


def test_a_job_reaches_the_maps_without_join(runner: Runner, gate: Gate) -> None:
    told = []
    runner.session.jobs.on_finish = told.append
    runner.run_text("slowly &")
    gate.open.set()
    assert wait_until(lambda: told, 10.0)
    assert missions(runner) == 5
    assert [job.state for job in told] == ["done"]


def test_a_cancelled_job_has_no_effect(runner: Runner, gate: Gate, capsys: Capture) -> None:
    runner.run_text("slowly &")
    gate.reached.wait(10)
    assert runner.run_text("cancel 1") == Status.OK
    job = runner.session.jobs.get(1)
    assert job.wait(10)
    assert job.state == "cancelled"
    assert missions(runner) == 1
    assert runner.run_text("cancel 1") == Status.USER_ERROR
    assert runner.run_text("join 7") == Status.USER_ERROR
    assert "known jobs: 1" in capsys.readouterr().err


def test_a_job_that_can_end_early_keeps_what_it_has(
    runner: Runner, gate: Gate, capsys: Capture
) -> None:
    def recording(context: CommandContext) -> Message:
        """Read an endless recording until the user ends it."""
        with ending_early() as is_to_end:
            gate.reached.set()
            wait_until(is_to_end)
            gate.open.wait(30)
            context.progress.check()
        context.commit(map_of(5))
        return Message("ended")

    runner.session.registry.add(describe(recording, "recording", ()), Plugin("recording"))
    for number, states in enumerate((["ending", "done"], ["ending", "cancelling", "cancelled"]), 1):
        gate.reached.clear()
        gate.open.clear()
        runner.run_text("recording &")
        gate.reached.wait(10)
        job = runner.session.jobs.get(number)
        for state in states[:-1]:
            assert runner.run_text(f"cancel {number}") == Status.OK
            assert job.state == state
        gate.open.set()
        assert job.wait(10)
        assert job.state == states[-1]
        assert missions(runner) == 5
    out = capsys.readouterr().out
    assert "ends with what it has: recording" in out
    assert "cancelled: recording" in out
    assert runner.run_text("join") == Status.OK


def test_a_failed_job_makes_join_fail(runner: Runner, gate: Gate, capsys: Capture) -> None:
    gate.open.set()
    assert runner.run_text("slowly --fails &; join") == Status.FAILED
    assert "job 1 failed: as was asked" in capsys.readouterr().err
    assert missions(runner) == 1


def test_a_script_waits_for_its_jobs(runner: Runner, gate: Gate, capsys: Capture) -> None:
    gate.open.set()
    assert runner.run_text("slowly &") == Status.OK
    assert runner.finish(discard=True) == Status.OK
    assert "consistent" in capsys.readouterr().out
    assert runner.run_text("add_mission --nosuch &") == Status.USER_ERROR


def test_jobs_from_python(runner: Runner, gate: Gate) -> None:
    job = runner.session.start("slowly", missions=7)
    gate.open.set()
    assert job.wait(10)
    assert job.report == Message("consistent")
    runner.session.run("join")
    assert missions(runner) == 7


def test_states_are_merged_map_by_map() -> None:
    maps = MapManager()
    for key in "abc":
        maps.add(key, VIMap())
    base = maps.state
    job = MapManager(base)
    job.update(job.get("a").with_value(map_of(1), "x"))
    job.update(job.get("b").with_value(map_of(2), "x"))
    job.remove("c")
    job.add("d", map_of(4))
    merged, conflicts = merge_states(base, job.state, base)
    assert (merged, conflicts) == (job.state, ())
    maps.update(maps.get("b").with_value(map_of(3), "y"))
    maps.select("a")
    merged, conflicts = merge_states(base, job.state, maps.state)
    sizes = {key: len(entry.vi_map.missions) for key, entry in merged.entries.items()}
    assert sizes == {"a": 1, "b": 3, "b-1": 2, "d": 4}
    assert conflicts == (Conflict("b", "b-1"),)
    assert merged.selected == "a"


def test_the_selection_survives_a_job_that_drops_the_selected_map() -> None:
    maps = MapManager()
    maps.add("a", VIMap())
    maps.add("b", VIMap())
    base = maps.state
    job = MapManager(base)
    job.remove("b")
    maps.add("c", VIMap(), select=False)
    merged, _ = merge_states(base, job.state, maps.state)
    assert merged.selected == "a"
    assert list(merged.entries) == ["a", "c"]


def test_a_session_knows_its_commands_as_functions(runner: Runner) -> None:
    session: Any = runner.session
    assert session.add_mission() == Message("2 missions")
    assert session.echo("a", "b") == Message("a b")
    assert "add_mission" in dir(session)
    with pytest.raises(AttributeError, match="no command 'nosuch'"):
        _ = session.nosuch


def test_work_that_follows_is_asked_to_end_by_itself() -> None:
    token = CancelToken()
    with token.ending_early():
        assert token.request_end()
    with token.ending_early():  # as the viewer that is kept after a recording
        assert not token.is_ending
        assert token.request_end()
        with token.ending_early():
            assert token.is_ending
            assert not token.request_end()
    assert not token.request_end()
