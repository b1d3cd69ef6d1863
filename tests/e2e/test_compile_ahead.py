"""On a fresh machine the prompt compiles while the user reads, and takes its processes with it."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from maplab_py.storage.native import save_map
from tests.e2e.support import Console, run_program
from tests.support.waiting import wait_until
from tests.vimap.builders import walk_map

PROCESS = "maplab_py.algorithms.background_compilation"


def lives(number: int) -> bool:
    try:
        return Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.parametrize("ends", ["quit", "killed"])
def test_processes_start_with_a_map_and_end_with_the_console(tmp_path: Path, ends: str) -> None:
    save_map(walk_map(), tmp_path / "walk")
    cache = tmp_path / "cache"
    cache.mkdir(mode=0o700)
    console = Console(tmp_path, MAPLAB_CACHE_DIR=str(cache))
    try:
        console.wait_for_prompt()
        console.enter("load walk")
        console.wait_for(lambda _: any(PROCESS in child for child in console.children()))
        numbers = [
            int(number)
            for path in Path(f"/proc/{console.child.pid}/task").glob("*/children")
            for number in path.read_text().split()
        ]
        if ends == "quit":
            console.wait_for_prompt("maplab <walk>:/$")
            console.enter("quit")
            assert console.status() == 0
        else:
            console.close()
        assert wait_until(lambda: not any(map(lives, numbers)))
    finally:
        console.close()
    modules = list(cache.rglob("*.py"))
    assert all(path.read_text().startswith('"""Generated') for path in modules)  # none is cut


def test_a_script_starts_none(tmp_path: Path) -> None:
    save_map(walk_map(), tmp_path / "walk")
    cache = tmp_path / "cache"
    cache.mkdir(mode=0o700)
    result = run_program(
        tmp_path, "-c", "load walk; map_stats", extra={"MAPLAB_CACHE_DIR": str(cache)}
    )
    assert result.returncode == 0, result.stderr
    assert not os.listdir(cache)
