"""Resources: every type, new ones until the save, bounded memory, copies and moves."""

import dataclasses
import errno
import gc
from pathlib import Path

import numpy as np
import pytest

from maplab_py.cancellation import CancelToken, obeying
from maplab_py.console.session.session import Session
from maplab_py.errors import Cancelled, MapError, UserError
from maplab_py.storage.native import load_map, save_map
from maplab_py.storage.resources import files as resource_files
from maplab_py.storage.resources import store as resource_store
from maplab_py.storage.resources.new import NewResources
from maplab_py.storage.resources.types import RESOURCE_TYPES, resource_type_of
from maplab_py.vimap import ResourceOwner, Resources, VIMap, consistency, edits, merge, random_ids
from maplab_py.vimap.queries import resource_missions, resources_of, without_resources
from tests.simulation.small import simulated
from tests.support.data import shared_data

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
        path = resource_store.resource_path(loaded, row, tmp_path / "map")
        assert path.read_bytes() == content_of(kind)
        assert path.is_relative_to(outside if is_external else tmp_path / "map")
    sensors = table.owner_kind == ResourceOwner.SENSOR
    np.testing.assert_array_equal(np.sort(table.timestamp_ns[sensors]), np.arange(25))
    assert resource_files.missing_files(loaded, tmp_path / "map") == []
    assert resource_files.orphaned_files((), loaded, tmp_path / "map") == []


def test_missing_and_orphaned_files_are_named(plain: VIMap, tmp_path: Path) -> None:
    folder = tmp_path / "map"
    save_map(with_every_type(plain), folder)
    loaded, _ = load_map(folder)
    missing = resource_store.resource_path(loaded, 0, folder)
    missing.unlink()
    orphan = folder / "resources" / "text" / "note.txt"
    orphan.write_text("left over")
    report = resource_files.with_file_checks(consistency.check_consistency(loaded), loaded, folder)
    assert [(e.rule, e.where) for e in report.errors] == [
        ("resource whose file is missing", (str(missing),))
    ]
    assert report.warnings[-1].where == (str(orphan.resolve()),)
    assert "missing" in report.failure
    homeless = resource_files.with_file_checks(consistency.check_consistency(loaded), loaded, None)
    assert homeless.errors[0].count == len(loaded.resources)


def test_removed_resources_leave_orphans_that_can_be_deleted(plain: VIMap, tmp_path: Path) -> None:
    folder = tmp_path / "map"
    save_map(with_every_type(plain), folder)
    loaded, _ = load_map(folder)
    fewer = without_resources(loaded, resources_of(loaded, (0, 16)))
    assert len(fewer.resources) == len(loaded.resources) - 6
    orphans = resource_files.orphaned_files((), fewer, folder)
    assert {path.parent.name for path in orphans} == {"raw_images", "point_cloud"}
    other = loaded.replace(
        metadata=dataclasses.replace(
            loaded.metadata, external_resource_folders=(str(folder / "resources"),)
        ),
        resources=loaded.resources.replace(folder=np.zeros(len(loaded.resources), dtype=np.int32)),
    )
    assert resource_files.orphaned_files((other,), fewer, folder) == []
    assert resource_files.remove_files(orphans) == (6, [])
    assert resource_files.orphaned_files((), fewer, folder) == []
    assert resource_files.missing_files(fewer, folder) == []


def test_a_cancelled_clean_up_stops(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_bytes(b"")
    token = CancelToken()
    token.cancelled = True
    with obeying(token), pytest.raises(Cancelled):
        resource_files.remove_files([file])
    assert file.exists()


def test_files_that_cannot_be_deleted_are_named(tmp_path: Path) -> None:
    removed, problems = resource_files.remove_files([tmp_path])
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
    merged, dropped = resource_files.with_merged_folders(vi_map, tmp_path / "map")
    assert dropped == [names[1], names[2], names[3]]
    assert merged.metadata.external_resource_folders == (names[0], names[4])
    assert merged.metadata.resource_folder_in_use == 1
    np.testing.assert_array_equal(merged.resources.folder[:6], [0, 0, -1, 0, 1, -1])
    again, nothing = resource_files.with_merged_folders(merged, tmp_path / "map")
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
    cache = resource_store.ResourceCache(max_bytes=10)

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


COUNT = 4


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a map folder with three text resources of frames and an image of the mission."""
    vi_map, _ = load_map(shared_data("maplab_maps/euroc_v1_01/euroc_v1_01_submap_3"))
    table = Resources.filled(
        COUNT,
        id=random_ids(COUNT, np.random.default_rng(1)),
        type=[11, 11, 11, 0],
        owner_kind=[ResourceOwner.FRAME] * 3 + [ResourceOwner.MISSION],
        owner=[0, 1, 1, 0],
    )
    vi_map = vi_map.replace(resources=table)
    folder = tmp_path / "map"
    save_map(vi_map, folder)
    for row in range(COUNT):
        path = folder / "resources" / resource_store.relative_path(vi_map, row)
        path.parent.mkdir(parents=True, exist_ok=True)
        image = b"P5 3 2 255\n" + bytes(range(6))
        path.write_bytes(image if row == COUNT - 1 else b"text %d" % row)
    return folder


def contents(vi_map: VIMap, folder: Path) -> list[bytes]:
    return [resource_store.resource_path(vi_map, row, folder).read_bytes() for row in range(COUNT)]


def test_store_loads_and_stays_within_its_bound(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache = resource_store.ResourceCache(max_bytes=13)
    monkeypatch.setattr(resource_store, "SHARED_CACHE", cache)
    vi_map, _ = load_map(folder)
    assert sorted(vi_map.resources.type) == [0, 11, 11, 11]
    rows = {int(vi_map.resources.type[row]): row for row in range(COUNT)}
    store = resource_store.ResourceStore(vi_map, folder)
    np.testing.assert_array_equal(store.load(rows[0]), [[0, 1, 2], [3, 4, 5]])
    texts = [row for row in range(COUNT) if row != rows[0]]
    assert sorted(store.load(row) for row in texts) == ["text 0", "text 1", "text 2"]
    store.load(texts[-1])
    statistics = cache.statistics()
    assert (statistics.hits, statistics.misses) == (1, 4)
    assert statistics.bytes <= 13
    resource_store.resource_path(vi_map, texts[0], folder).unlink()
    with pytest.raises(MapError, match="cannot be read"):
        resource_store.ResourceStore(vi_map, folder).load(texts[0])


def test_resources_come_along(folder: Path, tmp_path: Path) -> None:
    session = Session()
    session.run("load", map_folder=folder)
    session.run("save", map_folder=tmp_path / "other")
    before, after = load_map(folder)[0], load_map(tmp_path / "other")[0]
    assert contents(before, folder) == contents(after, tmp_path / "other")


def test_move_out_and_copy_back(folder: Path, tmp_path: Path) -> None:
    session = Session()
    session.run("load", map_folder=folder)
    wanted = contents(load_map(folder)[0], folder)
    outside = str(tmp_path / "outside")
    session.run("save", overwrite=True, move_resources_to_external_folder=outside)
    moved, _ = load_map(folder)
    assert moved.metadata.external_resource_folders == (outside,)
    assert contents(moved, folder) == wanted
    assert not [path for path in (folder / "resources").rglob("*") if path.is_file()]
    session.run("save", overwrite=True, copy_resources_to_map_folder=True)
    back, _ = load_map(folder)
    assert (back.resources.folder == -1).all()
    assert contents(back, folder) == wanted
    assert len([path for path in Path(outside).rglob("*") if path.is_file()]) == COUNT


def test_contradictions_are_refused(folder: Path) -> None:
    session = Session()
    session.run("load", map_folder=folder)
    with pytest.raises(UserError, match="only one"):
        session.run(
            "save",
            overwrite=True,
            copy_resources_to_map_folder=True,
            move_resources_to_external_folder="x",
        )


IMAGES = np.arange(3 * 4 * 5, dtype=np.uint8).reshape(3, 4, 5)


@pytest.fixture
def temporary(tmp_path: Path) -> Path:
    folder = tmp_path / "temporary"
    folder.mkdir()
    return folder


@pytest.fixture
def plain_map() -> VIMap:
    return load_map(shared_data("maplab_maps/euroc_v1_01/euroc_v1_01_submap_3"))[0]


def with_images(vi_map: VIMap, temporary: Path, seed: bytes = b"") -> VIMap:
    """Return the map with images of its first frames."""
    new = NewResources(temporary, seed=seed)
    rows = [new.add_image(image) for image in IMAGES]
    return new.attached(vi_map, rows, np.arange(len(rows)))


def images_of(vi_map: VIMap, folder: Path) -> list[np.ndarray]:
    store = resource_store.ResourceStore(vi_map, folder)
    rows = np.argsort(vi_map.resources.owner, kind="stable").tolist()
    return [store.load(row) for row in rows]


def test_staged_images_can_be_read_and_are_saved(
    plain_map: VIMap, temporary: Path, tmp_path: Path
) -> None:
    vi_map = with_images(plain_map, temporary)
    assert consistency.check_consistency(vi_map).failure == ""
    np.testing.assert_array_equal(images_of(vi_map, Path()), IMAGES)
    save_map(vi_map, tmp_path / "map")
    loaded, _ = load_map(tmp_path / "map")
    assert loaded.metadata.external_resource_folders == ()
    assert (loaded.resources.folder == -1).all()
    assert (loaded.resources.owner_kind == ResourceOwner.FRAME).all()
    files = sorted((tmp_path / "map" / "resources" / "raw_images").iterdir())
    assert [file.suffix for file in files] == [".pgm"] * 3
    np.testing.assert_array_equal(images_of(loaded, tmp_path / "map"), IMAGES)


def test_equal_input_gives_equal_ids(plain_map: VIMap, temporary: Path) -> None:
    a, b, c = (with_images(plain_map, temporary, seed) for seed in (b"1", b"1", b"2"))
    np.testing.assert_array_equal(a.resources.id, b.resources.id)
    assert not np.any(a.resources.id == c.resources.id)
    assert len(np.unique(a.resources.id, axis=0)) == 3


def test_the_temporary_folder_is_deleted_with_the_last_map(
    plain_map: VIMap, temporary: Path
) -> None:
    vi_map = with_images(plain_map, temporary)
    smaller = edits.remove_missions(vi_map, [0])
    del vi_map
    gc.collect()
    assert len(list(temporary.iterdir())) == 1
    del smaller
    gc.collect()
    assert list(temporary.iterdir()) == []


def test_undo_leaves_nothing_behind(plain_map: VIMap, temporary: Path, tmp_path: Path) -> None:
    session = Session()
    session.maps.add("map", plain_map)
    session.maps.update(session.maps.selected.with_value(with_images(plain_map, temporary), "add"))
    session.run("undo")
    session.run("save", map_folder=tmp_path / "map")
    assert not (tmp_path / "map" / "resources").exists()
    session.run("redo")
    session.run("save", map_folder=tmp_path / "map")
    assert len(list((tmp_path / "map" / "resources" / "raw_images").iterdir())) == 3
    session.maps.remove("map")
    gc.collect()
    assert list(temporary.iterdir()) == []


def test_a_failed_save_leaves_nothing_behind(
    plain_map: VIMap, temporary: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    vi_map = with_images(plain_map, temporary)
    target = tmp_path / "map"

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("maplab_py.storage.map_saving.link_or_copy", full)
        with pytest.raises(UserError, match="No space left on device"):
            save_map(vi_map, target)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["temporary"]
    save_map(vi_map, target)
    np.testing.assert_array_equal(images_of(load_map(target)[0], target), IMAGES)


def test_new_resources_go_to_the_external_folder_in_use(
    plain_map: VIMap, temporary: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    outside = tmp_path / "outside"
    outside.mkdir()
    metadata = dataclasses.replace(
        plain_map.metadata, external_resource_folders=(str(outside),), resource_folder_in_use=0
    )
    vi_map = with_images(plain_map.replace(metadata=metadata), temporary)
    with monkeypatch.context() as patch:
        patch.setattr("maplab_py.storage.map_saving._write", failing)
        with pytest.raises(UserError, match="stopped"):
            save_map(vi_map, tmp_path / "map")
    assert list(outside.iterdir()) == []
    save_map(vi_map, tmp_path / "map")
    loaded, _ = load_map(tmp_path / "map")
    assert loaded.metadata.external_resource_folders == (str(outside),)
    assert (loaded.resources.folder == 0).all()
    assert not (tmp_path / "map" / "resources").exists()
    np.testing.assert_array_equal(images_of(loaded, tmp_path / "map"), IMAGES)


def failing(*_: object) -> None:
    raise UserError("stopped")


def test_a_missing_temporary_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="TMPDIR"):
        NewResources(tmp_path / "nowhere")


def test_an_unknown_type_is_refused(temporary: Path) -> None:
    with pytest.raises(MapError, match="25"):
        NewResources(temporary).add(25, b"")


def test_merged_maps_keep_staged_files(plain_map: VIMap, temporary: Path, tmp_path: Path) -> None:
    base = with_images(plain_map, temporary, b"a")
    merged, _ = merge.merge_maps(base, with_images(plain_map, temporary, b"b"), assign_new_ids=True)
    del base
    gc.collect()
    save_map(merged, tmp_path / "map")
    loaded, _ = load_map(tmp_path / "map")
    assert len(loaded.resources) == 6
    np.testing.assert_array_equal(
        images_of(loaded, tmp_path / "map"), np.concatenate([IMAGES, IMAGES])
    )
