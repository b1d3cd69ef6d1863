"""Files that the next save takes over, and those that other processes and threads read."""

import dataclasses
import errno
import functools
import gzip
import os
import signal
import tempfile
import threading
from pathlib import Path

import numpy as np
import pytest

from maplab_py.array_types import U64
from maplab_py.errors import MapError, UserError
from maplab_py.storage import checksums, reading_processes
from maplab_py.storage import maplab_map_pb2 as pb
from maplab_py.storage.native import load_map, save_map
from maplab_py.storage.protobuf import map_files, scan
from maplab_py.storage.protobuf.file_contents import ColumnDigests, FileContent, digest_of
from maplab_py.storage.protobuf.tables_to_messages import Partition, contents, index_to_bytes
from maplab_py.storage.protobuf.vertices_to_messages import id_fields, tag_of
from maplab_py.storage.reading_processes import parts_ahead
from maplab_py.storage.unchanged_files import WrittenFiles
from maplab_py.vimap import VIMap, comparison, edits, merge, table
from tests.pipeline.support import child_processes
from tests.vimap.builders import walk_map


@functools.cache
def three_missions() -> VIMap:
    """Return a map as it is loaded."""
    vi_map = walk_map(seed=0, first_ns=10**9)
    for number in (1, 2):
        other = walk_map(seed=number, first_ns=10**9 * (1 + 100 * number))
        vi_map, _ = merge.merge_maps(vi_map, other)
    with tempfile.TemporaryDirectory() as folder:
        save_map(vi_map, Path(folder) / "map")
        return load_map(Path(folder) / "map")[0]


def moved(vi_map: VIMap, row: int) -> VIMap:
    """Return the map with one vertex elsewhere."""
    T_M_I = vi_map.vertices.T_M_I.copy()
    T_M_I[row, 4] += 0.25
    return vi_map.replace(vertices=vi_map.vertices.replace(T_M_I=T_M_I))


def inodes(folder: Path) -> dict[str, int]:
    return {path.name: path.stat().st_ino for path in (folder / "vi_map").iterdir()}


def changed(before: dict[str, int], after: dict[str, int]) -> set[str]:
    """Return the files that were written."""
    return {name for name, inode in after.items() if before.get(name) != inode}


def holds(folder: Path, vi_map: VIMap) -> bool:
    """Tell whether a folder is a sound map with the tables of a map."""
    loaded = load_map(folder)[0]
    return all(comparison.is_same(getattr(loaded, name), getattr(vi_map, name)) for name in TABLES)


TABLES = [
    f.name for f in dataclasses.fields(VIMap) if isinstance(getattr(VIMap(), f.name), table.Table)
]
ALWAYS = {"missions", "sensors.yaml", "vi_map_metadata"}


def test_only_what_has_changed_is_written(tmp_path: Path) -> None:
    vi_map, target, written = three_missions(), tmp_path / "map", WrittenFiles()
    save_map(vi_map, target, written=written)
    first = inodes(target)
    assert {"vertices0", "vertices1", "vertices2"} < set(first)
    edited = moved(vi_map, int(vi_map.vertex_start[1]))
    save_map(edited, target, force=True, written=written)
    assert changed(first, inodes(target)) == ALWAYS | {"vertices1"}
    assert holds(target, edited)
    assert written.reused == len(first) - len(ALWAYS) - 1


def test_stored_files_are_gzip_files_and_are_compressed_later(tmp_path: Path) -> None:
    vi_map, target, written = three_missions(), tmp_path / "map", WrittenFiles()
    save_map(vi_map, target, compress=False, written=written)
    stored = (target / "vi_map" / "vertices0").read_bytes()
    assert stored[:2] == b"\x1f\x8b"
    assert len(stored) > len(gzip.decompress(stored))
    assert holds(target, vi_map)
    save_map(vi_map, target, force=True, written=written)
    assert written.reused == 0
    packed = (target / "vi_map" / "vertices0").read_bytes()
    assert gzip.decompress(packed) == gzip.decompress(stored)
    assert len(packed) < len(stored)
    files = inodes(target)
    save_map(vi_map, target, force=True, compress=False, written=written)
    assert changed(files, inodes(target)) == ALWAYS  # compressed ones serve as well


def test_what_is_taken_over_equals_what_would_be_written(tmp_path: Path) -> None:
    vi_map, written = three_missions(), WrittenFiles()
    edited = moved(vi_map, 0)
    save_map(vi_map, tmp_path / "a", written=written)
    taken = save_map(edited, tmp_path / "a", force=True, written=written)
    fresh = save_map(edited, tmp_path / "b", written=WrittenFiles())
    assert written.reused
    assert taken.fingerprint == fresh.fingerprint


def test_measurements_that_change_in_any_column_are_written(tmp_path: Path) -> None:
    vi_map, target, written = three_missions(), tmp_path / "map", WrittenFiles()
    save_map(vi_map, target, written=written)
    for name in ("uv_px", "descriptor"):
        before = inodes(target)
        values = getattr(vi_map.keypoints, name).copy()
        values[-1] += 1
        vi_map = vi_map.replace(keypoints=vi_map.keypoints.replace(**{name: values}))
        save_map(vi_map, target, force=True, written=written)
        assert changed(before, inodes(target)) == ALWAYS | {"vertices2"}
        assert holds(target, vi_map)
    before = inodes(target)
    samples = vi_map.imu_samples.accel_gyro.copy()
    samples[0, 0] = -0.0 if samples[0, 0] == 0.0 else -samples[0, 0]
    edited = vi_map.replace(imu_samples=vi_map.imu_samples.replace(accel_gyro=samples))
    save_map(edited, target, force=True, written=written)
    assert changed(before, inodes(target)) == ALWAYS | {"edges0"}
    assert holds(target, edited)


def test_equal_measurements_are_hashed_once() -> None:
    columns = [np.arange(12.0).reshape(6, 2), np.zeros((6, 0)), np.arange(6, dtype=np.int8)]
    before = ColumnDigests()
    digest = before.of(b"a", columns)
    assert digest == digest_of(columns)
    assert digest != before.of(b"b", [columns[0].astype(np.float32), *columns[1:]])
    assert digest != before.of(b"c", [columns[0].reshape(4, 3), *columns[1:]])
    assert digest != before.of(b"d", columns[1:])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("maplab_py.storage.protobuf.file_contents.digest_of", lambda _: b"hashed")
        after = ColumnDigests(before)
        assert after.of(b"a", [values.copy() for values in columns]) == digest
        assert after.of(b"a", [columns[0] + 1.0, *columns[1:]]) == b"hashed"
        assert after.of(b"z", columns) == b"hashed"
        nan = [np.array([0.0, np.nan])]
        after.of(b"n", nan)
        assert ColumnDigests(after).of(b"n", [-nan[0]]) == b"hashed"  # equal values, other bytes


def test_files_that_are_taken_over_are_not_flushed_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    vi_map, target, written = three_missions(), tmp_path / "map", WrittenFiles()
    save_map(vi_map, target, written=written)
    flushed: list[int] = []
    fsync = os.fsync

    def noted(descriptor: int) -> None:
        flushed.append(os.fstat(descriptor).st_ino)
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", noted)
    save_map(moved(vi_map, 0), target, force=True, written=written)
    files = inodes(target)
    assert files["vertices0"] in flushed
    assert not {files["vertices1"], files["vertices2"], files["edges0"]} & set(flushed)


def test_a_mission_that_grows_leaves_the_files_of_others(tmp_path: Path) -> None:
    vi_map, target, written = three_missions(), tmp_path / "map", WrittenFiles()
    without = edits.remove_missions(vi_map, np.arange(3) == 1)
    save_map(without, target, written=written)
    before = inodes(target)
    save_map(vi_map, target, force=True, written=written)
    after = inodes(target)
    assert after["vertices0"] == before["vertices0"]
    assert after["vertices2"] == before["vertices1"]  # under another name


def test_readers_of_an_older_state_keep_theirs(tmp_path: Path) -> None:
    vi_map, target, written = three_missions(), tmp_path / "map", WrittenFiles()
    save_map(vi_map, target, written=written)
    older = tmp_path / "older"
    (older / "vi_map").mkdir(parents=True)
    for path in target.rglob("*"):
        if path.is_file():
            os.link(path, older / path.relative_to(target))
    for row in range(0, len(vi_map.vertices), 3):
        save_map(moved(vi_map, row), target, force=True, written=written)
    assert holds(older, vi_map)


def test_where_links_are_refused_files_are_copied(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: object, **__: object) -> None:
        raise OSError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "link", refused)
    vi_map, target, written = three_missions(), tmp_path / "map", WrittenFiles()
    edited = moved(vi_map, 0)
    save_map(vi_map, target, written=written)
    for value in (edited, vi_map, edited):
        save_map(value, target, force=True, written=written)
        assert written.reused
        assert holds(target, value)


def test_a_file_that_another_program_changed_is_written_again(tmp_path: Path) -> None:
    vi_map, target, written = three_missions(), tmp_path / "map", WrittenFiles()
    save_map(vi_map, target, written=written)
    first = inodes(target)
    (target / "vi_map" / "vertices1").write_bytes(b"damaged")
    (target / "vi_map" / "edges0").unlink()
    save_map(vi_map, target, force=True, written=written)
    assert changed(first, inodes(target)) >= {"vertices1"}
    assert holds(target, vi_map)


def test_a_failed_save_forgets_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    vi_map, target, written = three_missions(), tmp_path / "map", WrittenFiles()
    save_map(vi_map, target, written=written)
    edited = moved(vi_map, 0)

    def full(*_: object, **__: object) -> bytes:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(gzip, "compress", full)
        with pytest.raises(UserError, match="No space left"):
            save_map(edited, target, force=True, written=written)
    assert holds(target, vi_map)
    save_map(edited, target, force=True, written=written)
    assert written.reused
    assert holds(target, edited)


def test_the_partition_of_saves_is_that_of_maplab() -> None:
    vi_map = three_missions()
    names = [content.name for content in contents(vi_map, Partition())]
    assert names == ["vertices0", "edges0", "landmark_index"]
    assert [len(rows) for rows in Partition(vertices=7).vertex_rows(vi_map)][:-1] == [7] * (
        (len(vi_map.vertices) - 1) // 7
    )


def ids_of_all_sizes() -> U64:
    """Return ids (400, 2, 2) whose words take 1 to 10 bytes."""
    rng = np.random.default_rng(0)
    shifts = rng.integers(0, 64, (400, 2, 2), dtype=np.uint64)
    ids = rng.integers(0, 2**64, (400, 2, 2), dtype=np.uint64) >> shifts
    ids[0] = 0
    ids[1] = 2**64 - 1
    return ids


def test_fields_of_ids_have_the_bytes_of_their_messages() -> None:
    ids = ids_of_all_sizes()[:, 0]
    fields = id_fields(ids, tag_of(pb.VisualFrame, "landmark_ids"))
    for rows in (slice(0, 400), slice(0, 1), slice(7, 90), slice(400, 400)):
        message = pb.VisualFrame()
        for id_words in ids[rows].byteswap().tolist():
            message.landmark_ids.add().words.extend(id_words)
        assert fields.of(rows) == message.SerializeToString()
    assert id_fields(ids[:0], tag_of(pb.Landmark, "id")).start == [0]


def test_the_landmark_index_has_the_bytes_of_its_messages() -> None:
    ids = ids_of_all_sizes()
    message = pb.VIMap()
    for vertex, landmark in ids.byteswap().tolist():
        entry = message.landmark_index.add()
        entry.vertex_id.words.extend(vertex)
        entry.landmark_id.words.extend(landmark)
    columns = {"vertex_id": ids[:, 0], "landmark_id": ids[:, 1]}
    content = FileContent(3, "landmark_index", columns, index_to_bytes)
    assert content.data() == message.SerializeToString(deterministic=True)
    assert index_to_bytes({name: values[:0] for name, values in columns.items()}) == b""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a map of three files of vertices, which processes are worth."""
    monkeypatch.setenv("NUMBA_NUM_THREADS", "2")
    monkeypatch.setattr(reading_processes, "_WORTH_PROCESSES", 0)
    monkeypatch.setattr(reading_processes, "_processors", lambda: 2)
    vi_map = walk_map(vertices=55, seed=0, first_ns=10**9)
    vi_map, _ = merge.merge_maps(vi_map, walk_map(vertices=60, seed=1, first_ns=10**12))
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
    assert comparison.is_same(vi_map, read_here(folder))
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
    files = map_files.listed_files(folder)
    with parts_ahead(files) as ahead:
        assert ahead is not None
        for process in {*child_processes(os.getpid())} - others:
            os.kill(process, signal.SIGKILL)
        ahead.start(scan.MemoryBudget(10**9))
        assert [ahead.take(path) for _, path in files] == [None] * len(files)


def test_where_no_process_can_be_started_the_files_are_read_here(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = read_here(folder)

    def refused(*_: object, **__: object) -> None:
        raise OSError("Resource temporarily unavailable")

    monkeypatch.setattr("subprocess.Popen", refused)
    assert comparison.is_same(load_map(folder)[0], expected)


def test_results_are_in_the_order_of_the_values() -> None:
    assert checksums.map_in_threads(pow, range(50), [2] * 50) == [n**2 for n in range(50)]


def test_without_threads_the_results_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", refuse)
    assert checksums.map_in_threads(str, range(3)) == ["0", "1", "2"]


def test_errors_of_the_function_reach_the_caller() -> None:
    with pytest.raises(ZeroDivisionError):
        checksums.map_in_threads(lambda n: 1 // n, [1, 0])
