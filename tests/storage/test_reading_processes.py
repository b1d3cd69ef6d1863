"""Files of vertices that other processes read."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from maplab_py.errors import MapError
from maplab_py.storage import reading_processes
from maplab_py.storage.native import load_map, save_map
from maplab_py.storage.protobuf.map_files import listed_files
from maplab_py.storage.protobuf.scan import MemoryBudget
from maplab_py.storage.reading_processes import parts_ahead
from maplab_py.vimap import VIMap
from maplab_py.vimap.comparison import is_same
from maplab_py.vimap.merge import merge_maps
from tests.pipeline.support import child_processes
from tests.vimap.builders import walk_map


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a map of three files of vertices, which processes are worth."""
    monkeypatch.setenv("NUMBA_NUM_THREADS", "2")
    monkeypatch.setattr(reading_processes, "_WORTH_PROCESSES", 0)
    monkeypatch.setattr(reading_processes, "_processors", lambda: 2)
    vi_map = walk_map(vertices=55, seed=0, first_ns=10**9)
    vi_map, _ = merge_maps(vi_map, walk_map(vertices=60, seed=1, first_ns=10**12))
    save_map(vi_map, tmp_path / "map")
    return tmp_path / "map"


def read_here(folder: Path) -> VIMap:
    """Return the map as this process reads it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reading_processes, "_WORTH_PROCESSES", 1 << 60)
        return load_map(folder)[0]


def test_processes_read_the_same_map(folder: Path) -> None:
    others = {*child_processes(os.getpid())}  # of earlier tests
    vi_map, report = load_map(folder)
    assert is_same(vi_map, read_here(folder))
    assert report.vertices == 115
    assert not {*child_processes(os.getpid())} - others


def test_a_damaged_file_is_named(folder: Path) -> None:
    others = {*child_processes(os.getpid())}
    (folder / "checksums.sha256").unlink()
    damaged = folder / "vi_map" / "vertices1"
    damaged.write_bytes(damaged.read_bytes()[:-20])
    with pytest.raises(MapError) as here:
        read_here(folder)
    with pytest.raises(MapError) as elsewhere:
        load_map(folder)
    assert str(here.value) == str(elsewhere.value)
    assert "vertices1" in str(here.value)
    assert not {*child_processes(os.getpid())} - others


def test_a_bound_on_memory_holds_for_all_processes_together(folder: Path) -> None:
    with pytest.raises(MapError, match="proto_max_size_megabytes"):
        load_map(folder, max_size_megabytes=1)


def test_what_a_dead_process_had_is_read_here(folder: Path) -> None:
    others = {*child_processes(os.getpid())}
    files = listed_files(folder)
    with parts_ahead(files) as ahead:
        assert ahead is not None
        for process in {*child_processes(os.getpid())} - others:
            os.kill(process, signal.SIGKILL)
        ahead.start(MemoryBudget(10**9))
        assert [ahead.take(path) for _, path in files] == [None] * len(files)


def test_where_no_process_can_be_started_the_files_are_read_here(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = read_here(folder)

    def refused(*_: object, **__: object) -> None:
        raise OSError("Resource temporarily unavailable")

    monkeypatch.setattr("subprocess.Popen", refused)
    assert is_same(load_map(folder)[0], expected)
