"""Maps in memory, and their loading and saving."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from maplab_py.console.session.session import Session
from maplab_py.errors import MapError, UserError
from maplab_py.report import Message
from maplab_py.storage.mission_names import named
from maplab_py.storage.native import load_map, save_map
from maplab_py.storage.resources.files import missing_files
from maplab_py.storage.resources.new import NewResources
from maplab_py.vimap import VIMap, comparison
from tests.console.sample_plugin import map_of
from tests.vimap.builders import walk_map


@pytest.fixture
def session() -> Session:
    return Session()


@pytest.fixture
def disk(tmp_path: Path) -> dict[Path, VIMap]:
    """Three maps in folders, and their values by folder."""
    folders = [tmp_path / f"walk_{number}" for number in range(3)]
    for number, folder in enumerate(folders):
        save_map(walk_map(seed=number), folder)
    return {folder: load_map(folder)[0] for folder in folders}


@pytest.mark.parametrize(
    "command", ["load_merge_all_maps", "load_merge_all_submaps", "join_all_maps"]
)
def test_a_joined_map_has_the_resources_of_all(
    command: str, session: Session, tmp_path: Path
) -> None:
    for number in range(2):
        new, vi_map = NewResources(), walk_map(seed=number)
        image = np.full((4, 4), number, dtype=np.uint8)
        save_map(new.attached(vi_map, [new.add_image(image)], [0]), tmp_path / f"walk_{number}")
    if command == "join_all_maps":
        session.run("load_all", maps_folder=tmp_path)
        session.run(command, target_map_key="joined")
    else:
        session.run(command, maps_folder=tmp_path, target_map_key="joined")
    assert missing_files(session.vi_map, None) == []
    session.run("save", map_folder=tmp_path / "joined")
    loaded = load_map(tmp_path / "joined")[0]
    assert missing_files(loaded, tmp_path / "joined") == []
    assert len(loaded.resources) == 2


def test_load_selects_the_map_under_its_folders_name(
    session: Session, disk: dict[Path, VIMap], tmp_path: Path
) -> None:
    session.run("load", map_folder=tmp_path / "walk_0")
    assert session.maps.keys == ["walk_0"]
    assert list(session.vi_map.missions.name) == ["walk_0"]
    assert comparison.is_same(named(session.vi_map, [""]), disk[tmp_path / "walk_0"])
    assert session.maps.selected.is_saved
    with pytest.raises(UserError, match="'walk_0' is in use"):
        session.run("load", map_folder=tmp_path / "walk_0")
    session.run("load", map_folder=tmp_path / "walk_0", map_key="again", assign_new_ids=True)
    assert not session.maps.selected.is_saved
    assert not np.array_equal(session.vi_map.missions.id, disk[tmp_path / "walk_0"].missions.id)


def test_load_all_takes_all_maps_or_none(
    session: Session, disk: dict[Path, VIMap], tmp_path: Path
) -> None:
    shutil.copytree(tmp_path / "walk_2", tmp_path / "walk_9")
    (tmp_path / "walk_9" / "vi_map" / "missions").unlink()
    before = session.maps.state
    for command in ("load_all", "load_merge_all_maps", "load_merge_all_submaps"):
        with pytest.raises(MapError, match="walk_9"):
            session.run(command, maps_folder=tmp_path)
    assert session.maps.state is before
    shutil.rmtree(tmp_path / "walk_9")
    session.run("load_all", maps_folder=tmp_path)
    assert session.maps.keys == ["walk_0", "walk_1", "walk_2"]
    with pytest.raises(UserError, match="is in use"):
        session.run("load_all", maps_folder=tmp_path)


def test_load_merge_all_maps_goes_to_the_selected_map_or_a_new_one(
    session: Session, disk: dict[Path, VIMap], tmp_path: Path
) -> None:
    session.run("load_merge_all_maps", maps_folder=tmp_path, target_map_key="merged")
    assert len(session.vi_map.missions) == 3
    assert not session.maps.selected.is_saved
    with pytest.raises(MapError, match="--assign_new_ids"):
        session.run("load_merge_map", map_folder=tmp_path / "walk_1")
    session.run("load_merge_all_maps", maps_folder=tmp_path, assign_new_ids=True)
    assert session.maps.keys == ["merged"]
    assert len(session.vi_map.missions) == 6
    session.run("undo")
    assert len(session.vi_map.missions) == 3


@pytest.mark.parametrize("command", ["load_all", "list_maps_on_file_system"])
def test_a_folder_without_maps_is_named(
    session: Session, disk: dict[Path, VIMap], tmp_path: Path, command: str
) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match="no map in it"):
        session.run(command, maps_folder=tmp_path / "empty")
    with pytest.raises(UserError, match="no such folder"):
        session.run(command, maps_folder=tmp_path / "missing")


def test_save_needs_a_folder_and_overwrite(
    session: Session, disk: dict[Path, VIMap], tmp_path: Path
) -> None:
    session.maps.add("new", map_of(2))
    with pytest.raises(UserError, match="has no folder yet"):
        session.run("save")
    session.run("save", map_folder=tmp_path / "out")
    assert comparison.is_same(session.vi_map.missions, load_map(tmp_path / "out")[0].missions)
    assert session.maps.selected.is_saved
    with pytest.raises(UserError, match="use --overwrite"):
        session.run("save", map_folder=tmp_path / "walk_0")
    session.run("save", map_folder=tmp_path / "walk_0", overwrite=True)
    assert len(load_map(tmp_path / "walk_0")[0].missions) == 2


def test_save_all_writes_nothing_when_one_map_cannot_be_saved(
    session: Session, disk: dict[Path, VIMap], tmp_path: Path
) -> None:
    session.maps.add("a", map_of(1))
    session.maps.add("walk_0", map_of(2))
    with pytest.raises(UserError, match="'walk_0'"):
        session.run("save_all", maps_folder=tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["walk_0", "walk_1", "walk_2"]
    session.run("save_all", maps_folder=tmp_path / "out")
    assert len(load_map(tmp_path / "out" / "walk_0")[0].missions) == 2
    assert session.maps.unsaved == []


def test_a_map_is_saved_back_to_its_own_folder_without_a_flag(
    session: Session, disk: dict[Path, VIMap], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "link").symlink_to("walk_0")
    session.run("load", map_folder=Path("walk_0"))
    for folder in (None, Path("link"), tmp_path / "walk_0"):
        session.run("evaluate_landmark_quality")
        session.run("save", map_folder=folder)
        assert session.maps.selected.is_saved
    session.run("save_all")
    with pytest.raises(UserError, match="use --overwrite"):
        session.run("save", map_folder=tmp_path / "walk_1")
    session.run("set_map_folder", map_folder=tmp_path / "walk_1")
    with pytest.raises(UserError, match="use --overwrite"):
        session.run("save")


def test_what_another_console_has_saved_is_replaced_only_by_force(
    session: Session, disk: dict[Path, VIMap], tmp_path: Path
) -> None:
    folder = tmp_path / "walk_0"
    with Session() as other:
        for console in (session, other):
            console.run("load", map_folder=folder)
        other.run("load_merge_map", map_folder=tmp_path / "walk_1")
        other.run("save")
        for flags in ({}, {"overwrite": True}, {"overwrite": True, "dry_run": True}):
            with pytest.raises(UserError, match=r"changed by another program.*--force"):
                session.run("save", **flags)
        assert len(load_map(folder)[0].missions) == 2
        session.run("save", force=True)
        assert len(load_map(folder)[0].missions) == 1
        session.run("save")  # what it has written itself is known
        with pytest.raises(UserError, match="--force"):
            other.run("save")


def test_save_all_keeps_account_of_what_was_saved_before_it_failed(
    session: Session, disk: dict[Path, VIMap], tmp_path: Path
) -> None:
    from maplab_py.atomic import replaced_folder

    session.run("load_all", maps_folder=tmp_path)
    session.maps.select("walk_0")
    session.run("set_all_mission_baseframes_to_known")
    with replaced_folder(tmp_path / "walk_1"):  # another console is saving there
        report = session.run("save_all")
        assert "not saved: walk_1, walk_2" in report.failure
        assert "another program is saving" in report.failure
    assert session.maps.get("walk_0").is_saved


def test_a_command_without_effect_does_not_mark_the_map(
    session: Session, disk: dict[Path, VIMap], tmp_path: Path
) -> None:
    session.run("load", map_folder=tmp_path / "walk_0")
    entry = session.maps.selected
    session.run("set_all_mission_baseframes_to_unknown")
    session.run("use_map_resource_folder")
    session.run("schema")
    session.run("set_map_folder", map_folder=tmp_path / "walk_0")
    assert session.maps.selected.is_saved
    assert session.maps.selected == entry


def test_maps_in_memory(session: Session) -> None:
    session.run("create_new_map", map_key="a")
    session.run("copy_map", target_map_key="b")
    assert session.maps.selected_key == "a"
    session.run("rename_map", map_key="c")
    session.run("select", map_key="b")
    with pytest.raises(UserError, match="--yes"):
        session.run("delete_map")
    session.run("delete_map", yes=True)
    assert session.maps.keys == ["c"]
    assert session.maps.selected_key == "c"
    session.run("clear_storage", yes=True)
    assert session.run("list") == Message("no maps in memory")


def test_merge_and_join(session: Session) -> None:
    for number in range(3):
        session.maps.add(f"m{number}", walk_map(seed=number))
    session.run("merge_map", map_key="m0")
    assert len(session.vi_map.missions) == 2
    assert len(session.maps.get("m0").vi_map.missions) == 1
    with pytest.raises(UserError, match="selected map"):
        session.run("merge_map", map_key="m2")
    before = session.maps.state
    with pytest.raises(MapError):
        session.run("join_all_maps", target_map_key="all")
    assert session.maps.state is before
    session.run("undo")
    session.run("join_all_maps", target_map_key="all")
    assert session.maps.keys == ["all"]
    assert len(session.vi_map.missions) == 3
    with pytest.raises(UserError, match="two or more"):
        session.run("join_all_maps", target_map_key="again")


def test_undo_redo_snapshot_restore(session: Session) -> None:
    session.maps.add("a", walk_map(seed=1))
    first = session.vi_map
    session.run("snapshot", name="start")
    session.run("set_all_mission_baseframes_to_known")
    changed = session.vi_map
    session.run("undo")
    assert session.vi_map is first
    with pytest.raises(UserError, match="nothing to undo"):
        session.run("undo")
    session.run("redo")
    assert session.vi_map is changed
    with pytest.raises(UserError, match="nothing to redo"):
        session.run("redo")
    session.run("restore", name="start")
    assert session.vi_map is first
    with pytest.raises(UserError, match="there are: start"):
        session.run("restore", name="strat")
