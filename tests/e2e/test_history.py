"""The history of the tutorial, written as a script, makes the same map in a new process."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.docs.markdown import blocks
from tests.e2e.support import run_program
from tests.support.data import REPOSITORY


def files_of(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.mark.slow
def test_the_script_of_the_tutorial_makes_a_byte_identical_map(tmp_path: Path) -> None:
    text = "\n".join(text for _, text in blocks(REPOSITORY / "docs" / "tutorial.md", "maplab"))
    (tmp_path / "tutorial.maplab").write_text(
        text + "\nundo\nredo\nhistory --as_script > steps.maplab\n"
        "save --map_folder=first --overwrite\n"
    )
    done = run_program(tmp_path, "run", "tutorial.maplab", seconds=600)
    assert done.returncode == 0, done.stderr
    (tmp_path / "save.maplab").write_text("save --map_folder=second\n")
    done = run_program(tmp_path, "run", "steps.maplab", "save.maplab", seconds=600)
    assert done.returncode == 0, done.stderr
    first, second = files_of(tmp_path / "first"), files_of(tmp_path / "second")
    assert first.keys() == second.keys()
    assert [name for name in first if first[name] != second[name]] == []
    steps = (tmp_path / "steps.maplab").read_text().splitlines()
    assert steps[0].startswith("load_merge_all_maps ")
    assert not any(line.startswith(("undo", "redo", "map_stats", "save")) for line in steps)
