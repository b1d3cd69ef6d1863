"""The cache of loaded maps: equal to the files, and never trusted when something is wrong with it."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from maplab_py.console.session.session import Session
from maplab_py.errors import MapError
from maplab_py.storage import native
from maplab_py.storage.cache.column_file import mapped_bytes
from maplab_py.storage.native import LoadReport, MapCache, load_map, save_map
from maplab_py.vimap import VIMap, comparison, edits
from tests.support.data import shared_data

SUBMAP = "maplab_maps/euroc_v1_01/euroc_v1_01_submap_3"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "map"
    shutil.copytree(shared_data(SUBMAP), folder)
    for path in [folder, *folder.rglob("*")]:
        path.chmod(0o755)
    return folder


@pytest.fixture
def cache(tmp_path: Path) -> MapCache:
    return MapCache(1.0, tmp_path / "cache")


def entry(cache: MapCache) -> Path:
    (path,) = cache.folder.glob("*.columns")
    return path


def loads(folder: Path, cache: MapCache) -> tuple[VIMap, LoadReport, LoadReport]:
    """Load twice: the map of the second time, and both reports."""
    _, first = load_map(folder, cache=cache)
    vi_map, second = load_map(folder, cache=cache)
    return vi_map, first, second


def test_a_map_from_the_cache_is_the_map_of_the_files(folder: Path, cache: MapCache) -> None:
    (folder / "mission_names.txt").unlink(missing_ok=True)
    from_files, plain = load_map(folder)
    vi_map, first, second = loads(folder, cache)
    assert (plain.cache, first.cache, second.cache) == ("", "written", "read")
    assert comparison.is_same(vi_map, from_files)
    assert second.notes == plain.notes
    assert (second.files, second.megabytes) == (plain.files, plain.megabytes)
    assert entry(cache).stat().st_mode & 0o077 == 0 or cache.folder.stat().st_mode & 0o077 == 0


def test_columns_are_mapped_and_edits_share_them(folder: Path, cache: MapCache) -> None:
    vi_map, _, _ = loads(folder, cache)
    for column in (vi_map.keypoints.descriptor, vi_map.keypoints.uv_px, vi_map.vertices.T_M_I):
        assert mapped_bytes(column) == column.nbytes > 0
        assert not column.flags.writeable
    edited = vi_map.replace(vertices=vi_map.vertices.replace(T_M_I=vi_map.vertices.T_M_I + 0.0))
    assert mapped_bytes(edited.vertices.T_M_I) == 0
    assert edited.keypoints.descriptor is vi_map.keypoints.descriptor


def test_the_map_that_was_just_written_is_mapped_too(folder: Path, cache: MapCache) -> None:
    vi_map, report = load_map(folder, cache=cache)
    assert report.cache == "written"
    assert mapped_bytes(vi_map.keypoints.descriptor) == vi_map.keypoints.descriptor.nbytes


def truncate(path: Path) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])


def flip(offset: int) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        status = path.stat()
        content = bytearray(path.read_bytes())
        content[offset] ^= 1
        path.write_bytes(content)
        os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))  # as a failing disk would do

    return change


def touch(path: Path) -> None:
    os.utime(path)


def foreign_text(path: Path) -> None:
    path.write_text("something else\n" * 1000)


def writable_by_others(path: Path) -> None:
    path.chmod(0o666)


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (truncate, "truncated"),
        (flip(40), "its header is damaged"),
        (flip(-5000), "does not have its checksum"),
        (touch, "another program has written to it"),
        (foreign_text, "not a file of columns"),
        (writable_by_others, "can be written by other users"),
        (lambda path: path.write_bytes(b""), "not a file of columns"),
    ],
    ids=["truncated", "header", "column", "touched", "foreign", "writable", "empty"],
)
@pytest.mark.skipif(os.name != "posix", reason="needs permissions")
def test_a_damaged_entry_is_told_and_written_again(
    folder: Path, cache: MapCache, damage: Callable[[Path], object], said: str
) -> None:
    from_files, _ = load_map(folder)
    load_map(folder, cache=cache)
    damage(entry(cache))
    vi_map, report = load_map(folder, cache=cache)
    assert comparison.is_same(vi_map, from_files)
    assert report.cache == "written"
    assert any(said in note for note in report.notes)
    entry(cache).chmod(0o600)
    assert load_map(folder, cache=cache)[1].cache == "read"


def test_an_entry_of_another_map_under_this_name_is_refused(
    folder: Path, cache: MapCache, tmp_path: Path
) -> None:
    load_map(folder, cache=cache)
    wanted = entry(cache)
    other = tmp_path / "other"
    vi_map, _ = load_map(folder)
    save_map(edits.remove_landmarks(vi_map, np.arange(len(vi_map.landmarks)) < 5), other)
    load_map(other, cache=cache)
    (foreign,) = set(cache.folder.glob("*.columns")) - {wanted}
    os.replace(foreign, wanted)
    loaded, report = load_map(folder, cache=cache)
    assert len(loaded.landmarks) == len(vi_map.landmarks)
    assert "written for another map" in report.notes[-1]


def test_a_changed_map_is_not_taken_from_the_cache(folder: Path, cache: MapCache) -> None:
    vi_map, _, _ = loads(folder, cache)
    smaller = edits.remove_landmarks(vi_map, np.arange(len(vi_map.landmarks)) < 10)
    before = vi_map.keypoints.uv_px.copy()
    save_map(smaller, folder, overwrite=True)  # while its columns are mapped
    loaded, report = load_map(folder, cache=cache)
    assert report.cache == "written"
    assert len(loaded.landmarks) == len(smaller.landmarks)
    assert np.array_equal(vi_map.keypoints.uv_px, before)


def test_a_mapped_map_outlives_its_entry(folder: Path, cache: MapCache) -> None:
    vi_map, _, _ = loads(folder, cache)
    expected, _ = load_map(folder)
    entry(cache).unlink()
    assert comparison.is_same(vi_map.keypoints, expected.keypoints)


def test_a_file_without_its_checksum_is_refused_with_a_cache_as_without(
    folder: Path, cache: MapCache, tmp_path: Path
) -> None:
    target = tmp_path / "saved"
    save_map(load_map(folder)[0], target)
    load_map(target, cache=cache)
    side_file = target / "checksums.sha256"
    digest, _, name = side_file.read_text().splitlines()[-1].partition("  ")
    side_file.write_text(f"{digest[::-1]}  {name}\n")
    with pytest.raises(MapError, match="does not have its checksum"):
        load_map(target, cache=cache)


def test_a_repaired_map_is_not_cached(folder: Path, cache: MapCache) -> None:
    _, report = load_map(folder, repair=True, cache=cache)
    assert report.cache == ""
    assert cache.use().maps == 0


def test_the_oldest_entries_are_deleted(folder: Path, tmp_path: Path) -> None:
    vi_map, _ = load_map(folder)
    second = tmp_path / "second"
    save_map(edits.remove_landmarks(vi_map, np.arange(len(vi_map.landmarks)) < 3), second)
    cache = MapCache(1.5 * vi_map.nbytes() / 1e9, tmp_path / "cache")
    load_map(folder, cache=cache)
    first_entry = entry(cache)
    load_map(second, cache=cache)
    assert entry(cache) != first_entry
    tiny = MapCache(1e-6, tmp_path / "tiny")
    _, report = load_map(folder, cache=tiny)
    assert report.cache == ""
    assert "more than --map_cache_max_gb" in report.notes[-1]


def test_a_cache_that_cannot_be_written_does_not_prevent_loading(
    folder: Path, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("")
    _, report = load_map(folder, cache=MapCache(1.0, tmp_path / "file" / "cache"))
    assert report.cache == ""
    assert "not kept in the cache" in report.notes[-1]


def test_commands_do_the_same_on_mapped_columns(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(native, "MapCache", lambda max_gb: MapCache(max_gb, tmp_path / "cache"))
    results = []
    for flags in ({}, {"map_cache": True}, {"map_cache": True}):
        session = Session()
        session.run("load", map_folder=folder, **flags)
        session.run("kfh")
        session.run("landmark_sparsify", num_landmarks_to_keep=300)
        session.run("save", map_folder=tmp_path / f"result_{len(results)}")
        results.append(session.vi_map)
    assert len(list((tmp_path / "cache").glob("*.columns"))) == 1
    assert comparison.is_same(results[0], results[1])
    assert comparison.is_same(results[0], results[2])
