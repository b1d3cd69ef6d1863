"""Help: tasks, pages, and the search for words in names, flags and texts."""

from __future__ import annotations

import pytest
from maplab_plugins.console.help import TASKS

from maplab_py.console.commands.registry import Registry, load_registry
from maplab_py.console.session.session import Session
from maplab_py.console.terminal.output import ConsoleTerminal
from maplab_py.errors import UserError


@pytest.fixture(scope="module")
def session() -> Session:
    return Session(load_registry(), ConsoleTerminal())


@pytest.mark.parametrize(
    ("words", "first"),
    [
        (("ground", "truth"), "evaluate_localization"),
        (("wheel",), "import_wheel_odometry"),
        (("TUM",), "import_images"),
        (("rpg",), "export_trajectory_to_csv"),  # a choice of a flag
        (("covariance",), "assign_edge_uncertainties"),
    ],
)
def test_words_find_commands(session: Session, words: tuple[str, ...], first: str) -> None:
    assert session.help(*words).commands[0].command == first


def test_the_beginning_of_a_word_counts_but_no_part_in_it(session: Session) -> None:
    names = [line.command for line in session.help("tum").commands]
    assert "visualize_mesh" not in names  # its flags say frustum


def test_a_command_has_its_page_and_one_that_is_misspelt_a_proposal(session: Session) -> None:
    assert session.help("optvi").command == "optimize_visual_inertial"
    with pytest.raises(UserError, match="did you mean optvi"):
        session.help("optvii")
    with pytest.raises(UserError, match="no command has to do with 'zzz qqq'"):
        session.help("zzz", "qqq")


def test_every_command_of_the_tasks_exists(session: Session) -> None:
    registry: Registry = session.registry
    names = [name for task in TASKS for name in task.commands.split(", ")]
    assert [name for name in names if not registry.knows(name)] == []
    assert session.help().tasks == TASKS
