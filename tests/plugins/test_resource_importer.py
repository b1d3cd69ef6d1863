"""The commands of resources in the console: import, undo, save, check, remove, clean up."""

import gc
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from maplab_py.console.session.session import Session
from maplab_py.errors import FlagError, UserError
from tests.support.stereo_room import StereoRoom


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> StereoRoom:
    return StereoRoom.simulated(tmp_path_factory.mktemp("stereo"))


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder that gets temporary files."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


@pytest.fixture
def session(room: StereoRoom, temporary: Path) -> Iterator[Session]:
    with Session() as session:
        session.run("load", map_folder=room.map_folder)
        yield session


def files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file())


def test_from_files_to_a_map_and_back(
    session: Session, room: StereoRoom, tmp_path: Path, temporary: Path
) -> None:
    imported: Any = session.run("import_images", dataset_folder=room.recording)
    session.run("import_depth_maps", depth_folder=room.depth())
    statistics: Any = session.run("resource_statistics")
    assert {line.resource_type: line.resources for line in statistics.types} == {
        "raw_images": imported.attached,
        "raw_depth_maps": imported.attached // 2,
    }
    session.run("save", map_folder=tmp_path / "map")
    assert session.run("check_map_consistency").failure == ""
    assert len(files(tmp_path / "map" / "resources")) == imported.attached * 3 // 2
    session.run("export_images", dataset_folder=tmp_path / "images")
    assert len(list((tmp_path / "images/mav0/cam1/data").iterdir())) == imported.attached // 2
    cached: Any = session.run("resource_cache_statistics")
    assert "raw_images" in [line.resource_type for line in cached.types]


def test_a_failed_import_leaves_nothing_behind(
    session: Session, room: StereoRoom, tmp_path: Path, temporary: Path
) -> None:
    depth = tmp_path / "depth"
    depth.mkdir()
    for path in sorted(room.depth().iterdir()):
        (depth / path.name).symlink_to(path)
    last = sorted(depth.iterdir())[-1]
    last.unlink()
    last.write_bytes(b"damaged")
    before = session.vi_map
    with pytest.raises(UserError, match="is damaged"):
        session.run("import_depth_maps", depth_folder=depth)
    assert session.vi_map is before
    gc.collect()
    assert files(temporary) == []


def test_remove_and_clean_up(session: Session, room: StereoRoom, tmp_path: Path) -> None:
    folder = tmp_path / "map"
    session.run("import_depth_maps", depth_folder=room.depth())
    session.run("save", map_folder=folder)
    count = len(files(folder / "resources"))
    with pytest.raises(UserError, match="no resources of type raw_images"):
        session.run("remove_resources", resource_type="raw_images")
    session.run("remove_resources", resource_type="8")
    with pytest.raises(UserError, match="save it first"):
        session.run("clean_up_resource_folders", remove_orphans=True, yes=True)
    session.run("save")
    report: Any = session.run("check_map_consistency")
    assert report.failure == ""
    assert report.warnings[-1].count == count
    with pytest.raises(UserError, match="confirmation is needed"):
        session.run("clean_up_resource_folders", remove_orphans=True)
    listed: Any = session.run("clean_up_resource_folders")
    assert (listed.orphaned_files, listed.removed_files) == (count, 0)
    removed: Any = session.run("clean_up_resource_folders", remove_orphans=True, yes=True)
    assert removed.removed_files == count
    assert files(folder / "resources") == []


def test_wrong_values_are_refused(session: Session, tmp_path: Path) -> None:
    with pytest.raises(FlagError, match="every_nth"):
        session.run("import_images", dataset_folder=tmp_path, every_nth=0)
    with pytest.raises(FlagError, match="depth_scale"):
        session.run("import_depth_maps", depth_folder=tmp_path, depth_scale=0.0)
    with pytest.raises(UserError, match="no such resource type"):
        session.run("export_images", dataset_folder=tmp_path, resource_type="pictures")
