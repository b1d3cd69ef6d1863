"""The history file: several consoles append, and a disk that refuses stops nobody."""

from __future__ import annotations

import shutil
from pathlib import Path

from prompt_toolkit.history import InMemoryHistory

from maplab_py.console.prompt.loop import open_history


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
