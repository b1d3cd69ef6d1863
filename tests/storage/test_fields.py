"""Fields of the format: optional ones, those of other programs, and names of missions."""

import gzip
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import MapError
from maplab_py.storage import maplab_map_pb2 as pb
from maplab_py.storage.extension_fields import read_extension, with_extension
from maplab_py.storage.mission_names import FILE_NAME, is_name, named, with_folder_names
from maplab_py.storage.native import load_map, save_map
from maplab_py.storage.protobuf import ids, map_files
from maplab_py.vimap.ids import to_hex_list
from maplab_py.vimap.merge import merge_maps
from tests.console.sample_plugin import map_of
from tests.vimap.builders import walk_map


def edited(folder: Path, name: str, edit: Callable[[pb.VIMap], None]) -> None:
    """Change the message of one file of a map."""
    path = folder / "vi_map" / name
    message = pb.VIMap.FromString(gzip.decompress(path.read_bytes()))
    edit(message)
    path.write_bytes(gzip.compress(message.SerializeToString(), 1))
    (folder / "checksums.sha256").unlink()


@pytest.mark.parametrize("packed", [False, True])
def test_files_of_both_kinds_are_bounded(tmp_path: Path, packed: bool) -> None:
    path = tmp_path / "file"
    path.write_bytes(gzip.compress(bytes(1000)) if packed else bytes(1000))
    assert map_files.read_unpacked(path, 1000) == bytes(1000)
    with pytest.raises(MapError, match="--proto_max_size_megabytes"):
        map_files.read_unpacked(path, 999)


def test_switch_variables_come_back_with_their_variances(tmp_path: Path) -> None:
    vi_map = walk_map()
    edges = vi_map.loop_closure_edges.replace(
        switch_variable=np.array([0.25, 0.75]), switch_variable_variance=np.array([0.5, 2.0])
    )
    save_map(vi_map.replace(loop_closure_edges=edges), tmp_path / "map")
    loaded = load_map(tmp_path / "map")[0].loop_closure_edges
    np.testing.assert_array_equal(loaded.switch_variable, edges.switch_variable)
    np.testing.assert_array_equal(loaded.switch_variable_variance, edges.switch_variable_variance)


def test_an_edge_without_a_switch_variable_is_switched_on(tmp_path: Path) -> None:
    save_map(walk_map(), tmp_path / "map")

    def forget(message: pb.VIMap) -> None:
        for edge in message.edges:
            if edge.HasField("loop_closure"):
                edge.loop_closure.ClearField("switch_variable")

    edited(tmp_path / "map", "edges0", forget)
    loaded = load_map(tmp_path / "map")[0].loop_closure_edges
    assert loaded.switch_variable.tolist() == [1.0, 1.0]


def test_an_observation_behind_the_last_keypoint_is_not_one_of_the_next_frame(
    tmp_path: Path,
) -> None:
    save_map(walk_map(), tmp_path / "map")
    vi_map, _ = load_map(tmp_path / "map")  # landmarks in the order of the file
    start, landmark = vi_map.keypoint_start, vi_map.keypoints.landmark
    # a landmark of the first frame that is listed behind the one which the next frame sees first
    first = landmark[start[0] : start[1]]
    victim = int(first.max())
    assert 0 <= landmark[start[1]] < victim
    victim_id = vi_map.landmarks.id[victim].byteswap().tolist()
    observer = vi_map.vertices.id[0].byteswap().tolist()

    def lead_behind(message: pb.VIMap) -> None:
        for vertex in message.vertices:
            for one in vertex.landmark_store.landmarks:
                if list(one.id.words) == victim_id:
                    observers = [list(other.words) for other in one.observer_vertex_ids]
                    one.keypoint_indices[observers.index(observer)] = len(first)

    edited(tmp_path / "map", "vertices0", lead_behind)
    with pytest.raises(MapError, match="--repair"):
        load_map(tmp_path / "map")
    repaired, _ = load_map(tmp_path / "map", repair=True)
    lost = np.flatnonzero(repaired.keypoints.landmark != landmark)
    assert lost.tolist() == [start[0] + int(np.argmax(first))]


@pytest.mark.parametrize("size", [0, 1, 127, 128, 70_000])
def test_a_field_comes_back(size: int) -> None:
    content = bytes(range(256)) * (size // 256 + 1)
    field = with_extension(b"", 1000, content[:size])
    assert read_extension(field, 1000) == content[:size]
    assert read_extension(field, 999) is None
    assert with_extension(field, 1000, None) == b""


def test_other_fields_stay_and_a_field_is_there_once() -> None:
    foreign = (
        bytes([0xA0, 0x3F, 0x05]) + bytes([0xA9, 0x3F]) + bytes(8) + bytes([0xAD, 0x3F, 1, 2, 3, 4])
    )
    both = with_extension(foreign, 1000, b"one")
    both = with_extension(both, 1000, b"two")
    assert read_extension(both, 1000) == b"two"
    assert with_extension(both, 1000, None) == foreign


def test_protobuf_reads_and_writes_it_as_an_unknown_field() -> None:
    mission = pb.Mission(backbone=1)
    mission.MergeFromString(with_extension(b"", 1000, b"closures"))
    again = pb.Mission()
    again.ParseFromString(mission.SerializeToString())
    assert again.backbone == 1
    assert read_extension(ids.unknown_bytes(again), 1000) == b"closures"


@pytest.mark.parametrize("damaged", [b"\xc2\x3e\x05ab", b"\xc2", b"\xc7\x3e"])
def test_damaged_fields_are_an_error(damaged: bytes) -> None:
    with pytest.raises(MapError, match="damaged"):
        read_extension(damaged, 1000)


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
