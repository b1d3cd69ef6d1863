"""Names of missions: from the folder, in a side file, through merges."""

from __future__ import annotations

from pathlib import Path

import pytest

from maplab_py.errors import MapError
from maplab_py.storage.mission_names import FILE_NAME, is_name, named, with_folder_names
from maplab_py.storage.native import load_map, save_map
from maplab_py.vimap.ids import to_hex_list
from maplab_py.vimap.merge import merge_maps
from tests.console.sample_plugin import map_of


def names_of(folder: Path) -> list[str]:
    return list(load_map(folder)[0].missions.name)


def test_names_are_saved_beside_the_map_and_loaded_again(tmp_path: Path) -> None:
    folder = tmp_path / "office"
    save_map(named(map_of(2), ["monday", ""]), folder)
    assert (folder / FILE_NAME).read_text().split() == [
        to_hex_list(map_of(2).missions.id)[0],
        "monday",
    ]
    assert names_of(folder) == ["monday", ""]
    save_map(map_of(2), folder, overwrite=True)
    assert not (folder / FILE_NAME).exists()


def test_the_messages_of_a_map_do_not_depend_on_the_names(tmp_path: Path) -> None:
    plain = save_map(map_of(1), tmp_path / "plain")
    with_name = save_map(named(map_of(1), ["monday"]), tmp_path / "named")
    assert plain.fingerprint == with_name.fingerprint


@pytest.mark.parametrize(
    ("folder", "missions", "names"),
    [
        ("office", 1, ["office"]),
        ("office_submap_12", 1, ["office"]),
        ("office, east", 2, ["office_ east-1", "office_ east-2"]),
    ],
)
def test_unnamed_missions_are_named_after_the_folder(
    tmp_path: Path, folder: str, missions: int, names: list[str]
) -> None:
    vi_map = with_folder_names(map_of(missions), tmp_path / folder)
    assert list(vi_map.missions.name) == names
    assert all(map(is_name, names))


def test_given_names_are_kept(tmp_path: Path) -> None:
    vi_map = with_folder_names(named(map_of(2), ["monday", ""]), tmp_path / "office")
    assert list(vi_map.missions.name) == ["monday", "office-2"]


def test_merged_maps_keep_the_names() -> None:
    merged, _ = merge_maps(
        named(map_of(1), ["monday"]), named(map_of(1), ["tuesday"]), assign_new_ids=True
    )
    assert list(merged.missions.name) == ["monday", "tuesday"]


@pytest.mark.parametrize("text", ["monday\n", "0" * 32 + "  a,b\n", "\x00\n"])
def test_a_damaged_file_is_refused_with_its_line(tmp_path: Path, text: str) -> None:
    save_map(map_of(1), tmp_path / "office")
    (tmp_path / "office" / FILE_NAME).write_text(text)
    with pytest.raises(MapError, match=rf"{FILE_NAME}: line 1 .*delete it"):
        load_map(tmp_path / "office")
    (tmp_path / "office" / FILE_NAME).write_bytes(b"\xff\xfe")
    with pytest.raises(MapError, match="not text"):
        load_map(tmp_path / "office")


@pytest.mark.parametrize("text", ["", " a", "a,b", "a\nb", "x" * 61])
def test_what_cannot_be_a_name(text: str) -> None:
    assert not is_name(text)
