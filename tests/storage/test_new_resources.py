"""New resources: staged until the map is saved; undo and failed saves leave nothing behind."""

from __future__ import annotations

import dataclasses
import errno
import gc
from pathlib import Path

import numpy as np
import pytest

from maplab_py.atomic import files as atomic_files
from maplab_py.console.commands.registry import load_registry
from maplab_py.console.session.session import Session
from maplab_py.errors import MapError, UserError
from maplab_py.storage.native import load_map, save_map
from maplab_py.storage.resources.new import NewResources
from maplab_py.storage.resources.store import ResourceStore
from maplab_py.vimap import ResourceOwner, VIMap
from maplab_py.vimap.consistency import check_consistency
from maplab_py.vimap.edits import remove_missions
from maplab_py.vimap.merge import merge_maps
from tests.support.data import shared_data

IMAGES = np.arange(3 * 4 * 5, dtype=np.uint8).reshape(3, 4, 5)


@pytest.fixture
def temporary(tmp_path: Path) -> Path:
    folder = tmp_path / "temporary"
    folder.mkdir()
    return folder


@pytest.fixture
def plain() -> VIMap:
    return load_map(shared_data("maplab_maps/euroc_v1_01/euroc_v1_01_submap_3"))[0]


def with_images(vi_map: VIMap, temporary: Path, seed: bytes = b"") -> VIMap:
    """Return the map with images of its first frames."""
    new = NewResources(temporary, seed=seed)
    rows = [new.add_image(image) for image in IMAGES]
    return new.attached(vi_map, rows, np.arange(len(rows)))


def images_of(vi_map: VIMap, folder: Path) -> list[np.ndarray]:
    store = ResourceStore(vi_map, folder)
    rows = np.argsort(vi_map.resources.owner, kind="stable").tolist()
    return [store.load(row) for row in rows]


def test_staged_images_can_be_read_and_are_saved(
    plain: VIMap, temporary: Path, tmp_path: Path
) -> None:
    vi_map = with_images(plain, temporary)
    assert check_consistency(vi_map).failure == ""
    np.testing.assert_array_equal(images_of(vi_map, Path()), IMAGES)
    save_map(vi_map, tmp_path / "map")
    loaded, _ = load_map(tmp_path / "map")
    assert loaded.metadata.external_resource_folders == ()
    assert (loaded.resources.folder == -1).all()
    assert (loaded.resources.owner_kind == ResourceOwner.FRAME).all()
    files = sorted((tmp_path / "map" / "resources" / "raw_images").iterdir())
    assert [file.suffix for file in files] == [".pgm"] * 3
    np.testing.assert_array_equal(images_of(loaded, tmp_path / "map"), IMAGES)


def test_equal_input_gives_equal_ids(plain: VIMap, temporary: Path) -> None:
    a, b, c = (with_images(plain, temporary, seed) for seed in (b"1", b"1", b"2"))
    np.testing.assert_array_equal(a.resources.id, b.resources.id)
    assert not np.any(a.resources.id == c.resources.id)
    assert len(np.unique(a.resources.id, axis=0)) == 3


def test_the_temporary_folder_is_deleted_with_the_last_map(plain: VIMap, temporary: Path) -> None:
    vi_map = with_images(plain, temporary)
    smaller = remove_missions(vi_map, [0])
    del vi_map
    gc.collect()
    assert len(list(temporary.iterdir())) == 1
    del smaller
    gc.collect()
    assert list(temporary.iterdir()) == []


def test_undo_leaves_nothing_behind(plain: VIMap, temporary: Path, tmp_path: Path) -> None:
    session = Session(load_registry())
    session.maps.add("map", plain)
    session.maps.update(session.maps.selected.with_value(with_images(plain, temporary), "add"))
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
    plain: VIMap, temporary: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    vi_map = with_images(plain, temporary)
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
    plain: VIMap, temporary: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    outside = tmp_path / "outside"
    outside.mkdir()
    metadata = dataclasses.replace(
        plain.metadata, external_resource_folders=(str(outside),), resource_folder_in_use=0
    )
    vi_map = with_images(plain.replace(metadata=metadata), temporary)
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


def test_a_full_disk_is_one_line_with_remedy(
    temporary: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    new = NewResources(temporary)

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(atomic_files.PendingFile, "complete", full)
    with pytest.raises(UserError, match=r"No space left on device.*TMPDIR") as error:
        new.add_image(IMAGES[0])
    assert "\n" not in str(error.value)
    assert len(new) == 0
    assert [path for path in temporary.rglob("*") if path.is_file()] == []


def test_a_missing_temporary_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="TMPDIR"):
        NewResources(tmp_path / "nowhere")


def test_an_unknown_type_is_refused(temporary: Path) -> None:
    with pytest.raises(MapError, match="25"):
        NewResources(temporary).add(25, b"")


def test_merged_maps_keep_staged_files(plain: VIMap, temporary: Path, tmp_path: Path) -> None:
    base = with_images(plain, temporary, b"a")
    merged, _ = merge_maps(base, with_images(plain, temporary, b"b"), assign_new_ids=True)
    del base
    gc.collect()
    save_map(merged, tmp_path / "map")
    loaded, _ = load_map(tmp_path / "map")
    assert len(loaded.resources) == 6
    np.testing.assert_array_equal(
        images_of(loaded, tmp_path / "map"), np.concatenate([IMAGES, IMAGES])
    )
