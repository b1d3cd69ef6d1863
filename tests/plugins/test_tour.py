"""The tour checks what was typed, says what is missing, and survives other commands."""

from pathlib import Path

import pytest
from maplab_plugins.tour import Guide, Step, tour_steps

import maplab_py
from maplab_py.console.commands.lines import split_commands
from maplab_py.console.terminal.protocol import SilentTerminal
from maplab_py.errors import UserError
from maplab_py.report import Message, Report
from maplab_py.storage.native import save_map
from tests.vimap.builders import walk_map

STEPS = (
    Step("One", "because", "undo; redo", ("undo", "redo"), "That was one."),
    Step("Two", "because", "map_stats", ("map_stats",), "That was two."),
)


class Listener(SilentTerminal):
    """Keeps what is shown."""

    is_prompt = True

    def __init__(self) -> None:
        self.shown: list[str] = []

    def show(self, report: Report, command: str) -> None:
        assert isinstance(report, Message)
        self.shown.append(report.text)


@pytest.fixture
def listener() -> Listener:
    return Listener()


@pytest.fixture
def session(listener: Listener) -> maplab_py.Session:
    return maplab_py.Session(terminal=listener)


def test_a_step_is_done_when_all_its_commands_have_succeeded(
    session: maplab_py.Session, listener: Listener
) -> None:
    guide = Guide(session.registry, listener, STEPS)
    assert guide.text().startswith("Step 1 of 2: One")
    guide.after_line("undo", succeeded=True)
    assert "step 1 is still open, 1 command to go: redo" in listener.shown[-1]
    guide.after_line("redo", succeeded=True)
    assert "That was one." in listener.shown[-1]
    assert "Step 2 of 2: Two" in listener.shown[-1]
    guide.after_line("ms", succeeded=True)
    assert "still open" in listener.shown[-1] or guide.is_over
    guide.after_line("map_stats", succeeded=True)
    assert guide.is_over
    assert "The tour is over" in listener.shown[-1]


def test_errors_and_other_commands_do_not_end_it(
    session: maplab_py.Session, listener: Listener
) -> None:
    guide = Guide(session.registry, listener, STEPS)
    guide.after_line("undo; redo", succeeded=False)
    assert "that did not work" in listener.shown[-1]
    assert "Type: undo; redo" in listener.shown[-1]
    for line in ("!ls", "no_such_command", "help optvi", "'unclosed"):
        guide.after_line(line, succeeded=True)
    assert guide.index == 0
    count = len(listener.shown)
    guide.after_line("tour --skip", succeeded=True)
    guide.after_line("# a comment", succeeded=True)
    assert len(listener.shown) == count


def test_the_result_counts_not_only_the_command(
    session: maplab_py.Session, listener: Listener
) -> None:
    (first, *_) = tour_steps(Path("folder"))
    guide = Guide(session.registry, listener, (first,))
    guide.after_command(session.maps)
    guide.after_line("load elsewhere", succeeded=True)
    assert "the map 'office' is not selected" in listener.shown[-1]
    session.maps.add("office", walk_map(), is_saved=True)
    guide.after_command(session.maps)
    guide.after_line("load elsewhere", succeeded=True)
    assert guide.is_over


def test_every_line_of_the_tour_can_be_typed(session: maplab_py.Session) -> None:
    steps = tour_steps(Path("a folder"))
    assert len(steps) >= 10
    for step in steps:
        calls = [session.parse(words) for words in split_commands(step.line)]
        assert set(step.commands) <= {call.command.name for call in calls}
    taught = {name for step in steps for name in step.commands}
    assert taught >= {
        "load", "map_stats", "optimize_visual_inertial", "undo", "anchor_all_missions",
        "loopclosure_all_missions", "why", "visualize", "save", "new_plugin",
    }  # fmt: skip


def test_it_needs_a_prompt_and_can_be_ended(tmp_path: Path, listener: Listener) -> None:
    with pytest.raises(UserError, match="maplab tour"):
        maplab_py.Session().run("tour", folder=tmp_path)
    session = maplab_py.Session(terminal=listener)
    with pytest.raises(UserError, match="not running"):
        session.run("tour", stop=True)
    (tmp_path / "sessions").mkdir()
    (tmp_path / "sessions" / "truth.npz").touch()  # an earlier tour has simulated
    assert "Step 1 of" in str(session.run("tour", folder=tmp_path).as_text())
    assert "Step 2 of" in str(session.run("tour", skip=True).as_text())
    assert "ended" in str(session.run("tour", stop=True).as_text())


def test_recordings_of_somebody_else_are_not_replaced(tmp_path: Path, listener: Listener) -> None:
    (tmp_path / "sessions" / "session_1").mkdir(parents=True)
    (tmp_path / "sessions" / "session_1" / "precious").touch()
    with pytest.raises(UserError):
        maplab_py.Session(terminal=listener).run("tour", folder=tmp_path)
    assert (tmp_path / "sessions" / "session_1" / "precious").exists()


def test_it_sees_the_maps_of_the_session(tmp_path: Path, listener: Listener) -> None:
    """A command works on a draft of the session; the tour must not keep that."""
    (tmp_path / "sessions").mkdir()
    (tmp_path / "sessions" / "truth.npz").touch()
    save_map(walk_map(), tmp_path / "sessions" / "session_1")
    session = maplab_py.Session(terminal=listener)
    session.run("tour", folder=tmp_path)
    line = tour_steps(tmp_path)[0].line
    session.execute(session.parse(split_commands(line)[0]))
    session.watchers.after_line(line, succeeded=True)
    assert "Step 2 of" in listener.shown[-1]
