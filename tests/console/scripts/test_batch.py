"""Batch files: folders reach the commands whatever their names hold."""

from __future__ import annotations

from pathlib import Path

import pytest

from maplab_py.console.scripts.batch import FOLDER_TEMPLATE, Batch, run_batch
from maplab_py.console.scripts.runner import Runner
from maplab_py.console.session.session import Session
from maplab_py.console.session.status import Status
from maplab_py.console.terminal.output import ConsoleTerminal
from maplab_py.storage.native import save_map
from tests.vimap.builders import walk_map


@pytest.mark.parametrize("name", ["two words", "a;b", "it's", 'a "map"', "# no comment"])
def test_folders_are_taken_literally(tmp_path: Path, name: str) -> None:
    save_map(walk_map(), tmp_path / name)
    loaded = []

    def make_runner() -> Runner:
        runner = Runner(Session(), ConsoleTerminal())
        loaded.append(runner)
        return runner

    batch = Batch((str(tmp_path / name),), (f"load --map_folder={FOLDER_TEMPLATE}",))
    assert run_batch(batch, make_runner, keep_going=False, discard=False) == Status.OK
    assert [entry.folder for entry in loaded[0].session.maps] == [tmp_path / name]
