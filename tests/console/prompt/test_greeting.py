"""The lines that the prompt begins with."""

from __future__ import annotations

from pathlib import Path

import pytest

from maplab_py.console.prompt.greeting import greeting


def _map_at(folder: Path) -> None:
    (folder / "vi_map").mkdir(parents=True)
    (folder / "vi_map" / "vi_map_metadata").touch()


def test_it_names_the_version_and_the_way_to_help() -> None:
    (line,) = greeting([])
    assert line.startswith("maplab-py ")
    assert "help" in line


def test_it_proposes_the_maps_of_the_last_lines(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("a", "b c", "d"):
        _map_at(Path(name))
    lines = [
        "load d",
        "load gone",
        "load --map_folder=a; optvi",
        "save --map_folder='b c'",
        "load a",
    ]
    assert greeting(lines)[1:] == ["recent maps: load a · load 'b c' · load d"]


def test_lines_that_no_shell_reads_are_left_out() -> None:
    assert len(greeting(["load 'a", "", "; ;", "load"])) == 1
