"""Resource files: found, cached within bounds, brought along, copied and moved."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from maplab_py.console.commands.registry import load_registry
from maplab_py.console.session.session import Session
from maplab_py.errors import MapError, UserError
from maplab_py.storage.native import load_map, save_map
from maplab_py.storage.resources.store import ResourceStore, relative_path, resource_path
from maplab_py.storage.resources.types import RESOURCE_TYPES, resource_type
from maplab_py.vimap import ResourceOwner, VIMap
from maplab_py.vimap.ids import random_ids
from maplab_py.vimap.tables import Resources
from tests.support.data import shared_data

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
        path = folder / "resources" / relative_path(vi_map, row)
        path.parent.mkdir(parents=True, exist_ok=True)
        image = b"P5 3 2 255\n" + bytes(range(6))
        path.write_bytes(image if row == COUNT - 1 else b"text %d" % row)
    return folder


def contents(vi_map: VIMap, folder: Path) -> list[bytes]:
    return [resource_path(vi_map, row, folder).read_bytes() for row in range(COUNT)]


def test_there_are_the_formats_types() -> None:
    assert len(RESOURCE_TYPES) == 25
    assert resource_type(18).suffix == ".tsdf.voxblox"
    with pytest.raises(MapError, match="25"):
        resource_type(25)


def test_store_loads_and_stays_within_its_bound(folder: Path) -> None:
    vi_map, _ = load_map(folder)
    assert sorted(vi_map.resources.type) == [0, 11, 11, 11]
    rows = {int(vi_map.resources.type[row]): row for row in range(COUNT)}
    store = ResourceStore(vi_map, folder, max_bytes=13)
    np.testing.assert_array_equal(store.load(rows[0]), [[0, 1, 2], [3, 4, 5]])
    texts = [row for row in range(COUNT) if row != rows[0]]
    assert sorted(store.load(row) for row in texts) == ["text 0", "text 1", "text 2"]
    store.load(texts[-1])
    assert store.statistics.hits == 1
    assert store.statistics.misses == 4
    assert store.statistics.bytes <= 13
    resource_path(vi_map, texts[0], folder).unlink()
    with pytest.raises(MapError, match="cannot be read"):
        ResourceStore(vi_map, folder).load(texts[0])


def test_resources_come_along(folder: Path, tmp_path: Path) -> None:
    session = Session(load_registry())
    session.run("load", map_folder=folder)
    session.run("save", map_folder=tmp_path / "other")
    before, after = load_map(folder)[0], load_map(tmp_path / "other")[0]
    assert contents(before, folder) == contents(after, tmp_path / "other")


def test_move_out_and_copy_back(folder: Path, tmp_path: Path) -> None:
    session = Session(load_registry())
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
    session = Session(load_registry())
    session.run("load", map_folder=folder)
    with pytest.raises(UserError, match="only one"):
        session.run(
            "save",
            overwrite=True,
            copy_resources_to_map_folder=True,
            move_resources_to_external_folder="x",
        )
