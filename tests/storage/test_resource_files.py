"""Every resource type is added, saved and reloaded; missing, orphaned and equal folders."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from maplab_py.cancellation import CancelToken, obeying
from maplab_py.errors import Cancelled, UserError
from maplab_py.storage.native import load_map, save_map
from maplab_py.storage.resources.files import (
    missing_files,
    orphaned_files,
    remove_files,
    with_file_checks,
    with_merged_folders,
)
from maplab_py.storage.resources.new import NewResources
from maplab_py.storage.resources.store import ResourceCache, resource_path
from maplab_py.storage.resources.types import RESOURCE_TYPES, resource_type_of
from maplab_py.vimap import ResourceOwner, VIMap
from maplab_py.vimap.consistency import check_consistency
from maplab_py.vimap.resource_queries import resource_missions, resources_of, without_resources
from tests.simulation.small import simulated

OWNERS = (ResourceOwner.FRAME, ResourceOwner.MISSION, ResourceOwner.SENSOR)


def content_of(kind: int) -> bytes:
    return b"content of type %d" % kind


def with_every_type(vi_map: VIMap) -> VIMap:
    """Return the map with a resource of every type for each kind of owner."""
    new = NewResources(seed=b"test")
    for owner in OWNERS:
        rows = [new.add(kind.number, content_of(kind.number)) for kind in RESOURCE_TYPES]
        is_sensor = owner == ResourceOwner.SENSOR
        vi_map = new.attached(
            vi_map,
            rows,
            np.arange(len(rows)) if owner == ResourceOwner.FRAME else np.zeros(len(rows), int),
            owner,
            sensor_id=vi_map.missions.sensor_id[0, 1] if is_sensor else None,
            timestamp_ns=np.arange(len(rows)) if is_sensor else None,
        )
    return vi_map


@pytest.fixture(scope="module")
def plain() -> VIMap:
    return simulated().maps[0]


@pytest.mark.parametrize("is_external", [False, True])
def test_every_type_is_saved_and_reloaded(plain: VIMap, tmp_path: Path, is_external: bool) -> None:
    outside = tmp_path / "outside"
    if is_external:
        outside.mkdir()
        metadata = dataclasses.replace(
            plain.metadata, external_resource_folders=(str(outside),), resource_folder_in_use=0
        )
        plain = plain.replace(metadata=metadata)
    vi_map = with_every_type(plain)
    save_map(vi_map, tmp_path / "map")
    loaded, _ = load_map(tmp_path / "map")
    table = loaded.resources
    assert len(table) == len(OWNERS) * len(RESOURCE_TYPES)
    for row, kind in enumerate(table.type.tolist()):
        path = resource_path(loaded, row, tmp_path / "map")
        assert path.read_bytes() == content_of(kind)
        assert path.is_relative_to(outside if is_external else tmp_path / "map")
    sensors = table.owner_kind == ResourceOwner.SENSOR
    np.testing.assert_array_equal(np.sort(table.timestamp_ns[sensors]), np.arange(25))
    assert missing_files(loaded, tmp_path / "map") == []
    assert orphaned_files((), loaded, tmp_path / "map") == []


def test_missing_and_orphaned_files_are_named(plain: VIMap, tmp_path: Path) -> None:
    folder = tmp_path / "map"
    save_map(with_every_type(plain), folder)
    loaded, _ = load_map(folder)
    missing = resource_path(loaded, 0, folder)
    missing.unlink()
    orphan = folder / "resources" / "text" / "note.txt"
    orphan.write_text("left over")
    report = with_file_checks(check_consistency(loaded), loaded, folder)
    assert [(e.rule, e.where) for e in report.errors] == [
        ("resource whose file is missing", (str(missing),))
    ]
    assert report.warnings[-1].where == (str(orphan.resolve()),)
    assert "missing" in report.failure
    homeless = with_file_checks(check_consistency(loaded), loaded, None)
    assert homeless.errors[0].count == len(loaded.resources)


def test_removed_resources_leave_orphans_that_can_be_deleted(plain: VIMap, tmp_path: Path) -> None:
    folder = tmp_path / "map"
    save_map(with_every_type(plain), folder)
    loaded, _ = load_map(folder)
    fewer = without_resources(loaded, resources_of(loaded, (0, 16)))
    assert len(fewer.resources) == len(loaded.resources) - 6
    orphans = orphaned_files((), fewer, folder)
    assert {path.parent.name for path in orphans} == {"raw_images", "point_cloud"}
    other = loaded.replace(
        metadata=dataclasses.replace(
            loaded.metadata, external_resource_folders=(str(folder / "resources"),)
        ),
        resources=loaded.resources.replace(folder=np.zeros(len(loaded.resources), dtype=np.int32)),
    )
    assert orphaned_files((other,), fewer, folder) == []
    assert remove_files(orphans) == (6, [])
    assert orphaned_files((), fewer, folder) == []
    assert missing_files(fewer, folder) == []


def test_a_cancelled_clean_up_stops(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_bytes(b"")
    token = CancelToken()
    token.cancelled = True
    with obeying(token), pytest.raises(Cancelled):
        remove_files([file])
    assert file.exists()


def test_files_that_cannot_be_deleted_are_named(tmp_path: Path) -> None:
    removed, problems = remove_files([tmp_path])
    assert removed == 0
    assert str(tmp_path) in problems[0]


def test_equal_folders_are_merged(plain: VIMap, tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "a")
    names = (
        str(tmp_path / "a"),
        f"{tmp_path}/b/../a",
        str(tmp_path / "map" / "resources"),
        str(tmp_path / "link"),
        str(tmp_path / "b"),
    )
    (tmp_path / "b").mkdir()
    vi_map = with_every_type(plain)
    folder = np.resize([0, 1, 2, 3, 4, -1], len(vi_map.resources)).astype(np.int32)
    vi_map = vi_map.replace(
        resources=vi_map.resources.replace(folder=folder),
        metadata=dataclasses.replace(
            vi_map.metadata, external_resource_folders=names, resource_folder_in_use=4
        ),
    )
    merged, dropped = with_merged_folders(vi_map, tmp_path / "map")
    assert dropped == [names[1], names[2], names[3]]
    assert merged.metadata.external_resource_folders == (names[0], names[4])
    assert merged.metadata.resource_folder_in_use == 1
    np.testing.assert_array_equal(merged.resources.folder[:6], [0, 0, -1, 0, 1, -1])
    again, nothing = with_merged_folders(merged, tmp_path / "map")
    assert again is merged
    assert nothing == []


def test_resources_are_chosen_by_type_and_mission(plain: VIMap) -> None:
    vi_map = with_every_type(plain)
    assert (resource_missions(vi_map) == 0).all()
    assert resources_of(vi_map, (8, 9)).sum() == 6
    assert resources_of(vi_map, None, np.array([0])).all()
    assert not resources_of(vi_map, None, np.array([1])).any()


def test_types_are_named_by_number_or_folder() -> None:
    assert resource_type_of("8") is resource_type_of("raw_depth_maps") is RESOURCE_TYPES[8]
    with pytest.raises(UserError, match=r"--resource_type=depth.*9 optimized_depth_maps"):
        resource_type_of("depth")


def test_the_cache_counts_by_type_and_sees_changes(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_bytes(b"one")
    cache = ResourceCache(max_bytes=10)

    def read(path: Path) -> tuple[bytes, int]:
        data = path.read_bytes()
        return data, len(data)

    assert [cache.load(file, 11, read) for _ in range(3)] == [b"one"] * 3
    file.write_bytes(b"changed")
    assert cache.load(file, 11, read) == b"changed"
    other = tmp_path / "other"
    other.write_bytes(b"12345")
    assert cache.load(other, 0, read) == b"12345"
    assert cache.kinds() == [0, 11]
    assert dataclasses.astuple(cache.statistics(11)) == (2, 2, 0, 0)
    assert dataclasses.astuple(cache.statistics()) == (2, 3, 1, 5)
