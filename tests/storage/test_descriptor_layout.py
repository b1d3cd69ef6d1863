"""Both layouts of descriptors go through load and save byte for byte; damaged blocks are refused."""

import struct
from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import MapError, UserError
from maplab_py.storage.native import find_maps, load_map, save_map
from maplab_py.storage.protobuf.descriptor_layout import read_blocks
from maplab_py.vimap import DescriptorBlock, VIMap, consistency
from maplab_py.vimap.tables import DescriptorLayout
from tests.storage.test_native import differences
from tests.support import descriptor_blocks as by_hand
from tests.support.data import shared_data
from tests.vimap.builders import walk_map

SUBMAP = "maplab_maps/euroc_v1_01/euroc_v1_01_submap_3"
KINDS = {"one": by_hand.ONE_TYPE, "three": by_hand.THREE_TYPES}


def check_round_trip(source: Path, target: Path) -> VIMap:
    """Load, save and load; the descriptors of both files must be equal, byte for byte."""
    first, report = load_map(source)
    assert report.notes == []
    assert consistency.check_consistency(first).failure == ""
    save_map(first, target)
    second, _ = load_map(target)
    assert by_hand.described(target) == by_hand.described(source)
    assert differences(first, second) == []
    return second


def check_table(vi_map: VIMap, folder: Path) -> None:
    """Compare every row of the map's table with what the file says."""
    expected = by_hand.described(folder)
    kinds, descriptor = vi_map.feature_type, vi_map.keypoints.descriptor
    assert len(expected) == len(vi_map.frames)
    for row in range(len(vi_map.frames)):
        types, data = expected[tuple(vi_map.frames.id[row].byteswap().tolist())]
        begin = int(vi_map.keypoint_start[row])
        decoded = by_hand.decode(data, types)
        assert len(decoded) == vi_map.frames.keypoint_count[row]
        for index, (kind, content) in enumerate(decoded, begin):
            assert kinds[index] == kind
            assert descriptor[index, : len(content)].tobytes() == content
            assert not descriptor[index, len(content) :].any()


@pytest.mark.parametrize("kinds", KINDS)
def test_a_real_map_in_blocks_survives_load_and_save(tmp_path: Path, kinds: str) -> None:
    source = by_hand.reencode(shared_data(SUBMAP), tmp_path / "source", KINDS[kinds], marked=True)
    vi_map = check_round_trip(source, tmp_path / "again")
    check_table(vi_map, source)
    uv = vi_map.keypoints.uv_px
    assert np.array_equal(vi_map.keypoints.position_3d, by_hand.marks_3d(uv))
    assert np.array_equal(vi_map.keypoints.time_offset_ns[:, 0], by_hand.marks_ns(uv))


@pytest.mark.slow
def test_every_real_legacy_map_keeps_its_bytes(tmp_path: Path) -> None:
    folders = find_maps(shared_data("maplab_maps"))
    assert len(folders) == 9
    for index, folder in enumerate(folders):
        vi_map = check_round_trip(folder, tmp_path / str(index))
        assert (vi_map.frames.descriptor_layout == DescriptorLayout.LEGACY).all()


def test_a_legacy_map_keeps_its_layout(tmp_path: Path) -> None:
    vi_map = check_round_trip(shared_data(SUBMAP), tmp_path / "map")
    assert (vi_map.frames.descriptor_layout == DescriptorLayout.LEGACY).all()
    assert (vi_map.feature_type == 0).all()


def test_a_layout_can_be_chosen(tmp_path: Path) -> None:
    source = shared_data(SUBMAP)
    save_map(load_map(source)[0], tmp_path / "blocks", descriptor_layout="2.2")
    bare = by_hand.described(source)
    for name, (types, data) in by_hand.described(tmp_path / "blocks").items():
        decoded = by_hand.decode(data, types)
        assert {kind for kind, _ in decoded} == {0}
        assert b"".join(content for _, content in decoded) == bare[name][1]
    check_round_trip(tmp_path / "blocks", tmp_path / "blocks_again")
    save_map(load_map(tmp_path / "blocks")[0], tmp_path / "bare", descriptor_layout="legacy")
    assert by_hand.described(tmp_path / "bare") == bare


def test_the_legacy_layout_refuses_what_it_cannot_hold(tmp_path: Path) -> None:
    for name, kinds in (("several", by_hand.THREE_TYPES), ("floats", ((1, 5, 256),))):
        source = by_hand.reencode(shared_data(SUBMAP), tmp_path / name, kinds)
        target = tmp_path / f"{name}_legacy"
        with pytest.raises(UserError, match=r"frame \w{32} has descriptors of .*=2\.2") as refused:
            save_map(load_map(source)[0], target, descriptor_layout="legacy")
        assert "\n" not in str(refused.value)
        assert not target.exists()


def test_new_maps_are_written_in_blocks(tmp_path: Path) -> None:
    vi_map = walk_map()
    save_map(vi_map, tmp_path / "map")
    check_table(vi_map, tmp_path / "map")
    save_map(vi_map, tmp_path / "legacy", descriptor_layout="legacy")
    expected = {
        tuple(words): vi_map.keypoints.descriptor[begin:end].tobytes()
        for words, begin, end in zip(
            vi_map.frames.id.byteswap().tolist(),
            vi_map.keypoint_start[:-1],
            vi_map.keypoint_start[1:],
            strict=True,
        )
    }
    for name, (types, data) in by_hand.described(tmp_path / "legacy").items():
        assert (types, data) == ((), expected[name])


def test_a_frame_that_is_set_always_has_a_list_of_blocks_in_2_2(tmp_path: Path) -> None:
    vi_map = walk_map()
    none = vi_map.frames.replace(descriptor_blocks=np.full(len(vi_map.frames), None))
    save_map(vi_map.replace(frames=none), tmp_path / "as_loaded")
    save_map(vi_map.replace(frames=none), tmp_path / "2.2", descriptor_layout="2.2")
    assert {data for _, data in by_hand.described(tmp_path / "as_loaded").values()} == {b""}
    assert {data for _, data in by_hand.described(tmp_path / "2.2").values()} == {bytes(8)}
    assert (load_map(tmp_path / "2.2")[0].feature_type == -1).all()


# -- detection ------------------------------------------------------------------------------------


def header(numbers: int, columns: int, depth: int = 0, channels: int = 1) -> bytes:
    return struct.pack("<IIII", numbers, columns, depth, channels)


def test_the_layout_is_told_by_exact_length() -> None:
    blocks = struct.pack("<Q", 1) + header(48, 10) + bytes(480)
    bare = (DescriptorLayout.LEGACY, (DescriptorBlock(10, 48),))
    assert read_blocks(bytes(480), [], 10) == bare
    assert read_blocks(blocks, [0], 10) == (DescriptorLayout.BLOCKS, (DescriptorBlock(10, 48),))
    assert read_blocks(b"", [], 10) == (DescriptorLayout.BLOCKS, None)
    assert read_blocks(bytes(8), [], 0) == (DescriptorLayout.BLOCKS, ())


def test_an_empty_block_is_kept() -> None:
    data = struct.pack("<Q", 2) + header(48, 3) + bytes(144) + header(256, 0, 5)
    layout, blocks = read_blocks(data, [0, 1], 3)
    assert (layout, blocks) == (
        DescriptorLayout.BLOCKS,
        (DescriptorBlock(3, 48), DescriptorBlock(0, 1024, 5, 1)),
    )


def test_bytes_that_fit_both_layouts_are_blocks() -> None:
    # 24 bytes of header are one byte for each of 24 keypoints: 1 + 48 bytes each
    data = struct.pack("<Q", 1) + header(48, 24) + bytes(48 * 24)
    assert len(data) % 24 == 0
    for types in ([], [0]):
        layout, blocks = read_blocks(data, types, 24)
        assert (layout, blocks) == (DescriptorLayout.BLOCKS, (DescriptorBlock(24, 48),))


def test_damaged_blocks_are_not_taken_for_bare_descriptors() -> None:
    for damaged in (header(47, 24), header(48, 24, 3), header(48, 24, 0, 2), header(48, 23)):
        data = struct.pack("<Q", 1) + damaged + bytes(48 * 24)
        for types in ([], [0]):
            with pytest.raises(MapError):
                read_blocks(data, types, 24)
    # without descriptor types bytes that look like no header are bare
    noise = np.random.default_rng(0).bytes(48 * 24)
    assert read_blocks(noise, [], 24)[0] == DescriptorLayout.LEGACY
    assert read_blocks(bytes(48 * 24), [], 24)[0] == DescriptorLayout.LEGACY
    with pytest.raises(MapError):
        read_blocks(noise, [0], 24)


@pytest.mark.parametrize(
    ("data", "types", "keypoints", "says"),
    [
        (
            struct.pack("<Q", 2) + header(4, 1) + bytes(16),
            [0, 0],
            1,
            "block 1 starts after the end",
        ),
        (struct.pack("<Q", 1 << 60) + bytes(40), [0], 3, "blocks do not fit into 48 bytes"),
        (struct.pack("<Q", 1) + header(4, 2) + bytes(4), [0], 2, "block 0 ends after the end"),
        (struct.pack("<Q", 1) + header(4, 1, 7) + bytes(4), [0], 1, "depth 7"),
        (struct.pack("<Q", 1) + header(4, 1, 0, 3) + bytes(4), [0], 1, "3 channels"),
        (struct.pack("<Q", 1) + header(1 << 31, 1) + bytes(4), [0], 1, "bytes per descriptor"),
        (struct.pack("<Q", 1) + header(0, 1), [0], 1, "no bytes"),
        (struct.pack("<Q", 1) + header(4, 1) + bytes(9), [0], 1, "5 bytes follow"),
        (struct.pack("<Q", 1) + header(4, 1) + bytes(4), [0], 2, "1 descriptors for 2 keypoints"),
        (struct.pack("<Q", 1) + header(4, 1) + bytes(4), [0, 1], 1, "2 descriptor types for 1"),
        (struct.pack("<Q", 1) + header(1, 1, 5) + bytes(4), [], 1, "does not say of which type"),
        (b"", [0], 0, "1 descriptor types, but no descriptors"),
        (b"abc", [0], 3, "too short"),
        (bytes(100), [], 3, "the size of descriptors does not fit 3 keypoints"),
        (bytes(100), [], 0, "the size of descriptors does not fit 0 keypoints"),
        (bytes(1 << 15), [], 1, "bytes per descriptor are more than"),
    ],
    ids=lambda value: value.replace(" ", "_") if isinstance(value, str) else "",
)
def test_what_is_wrong_is_said(data: bytes, types: list[int], keypoints: int, says: str) -> None:
    with pytest.raises(MapError, match=says):
        read_blocks(data, types, keypoints)


# -- damaged files --------------------------------------------------------------------------------


def mutated(data: bytes, rng: np.random.Generator, most: int = 3) -> bytes:
    """Return blocks with one or several fields of their headers changed."""
    fields, place = [(0, "<Q")], 8
    for _ in range(struct.unpack_from("<Q", data)[0]):
        numbers, columns, depth, _ = struct.unpack_from("<IIII", data, place)
        fields += [(place + 4 * field, "<I") for field in range(4)]
        place += 16 + numbers * columns * {0: 1, 5: 4}[depth]
    changed = bytearray(data)
    while bytes(changed) == data:
        for _ in range(rng.integers(1, most + 1)):
            offset, kind = fields[rng.integers(len(fields))]
            (value,) = struct.unpack_from(kind, changed, offset)
            bits = 8 * struct.calcsize(kind)
            value = (
                value + 1,
                value - 1,
                value ^ 1 << int(rng.integers(bits)),
                int(rng.integers(1 << int(rng.integers(1, bits)))),
                -1,
                0,
                2 * value,
                value << 8,
            )[rng.integers(8)]
            struct.pack_into(kind, changed, offset, value % (1 << bits))
    return bytes(changed)


@pytest.mark.parametrize("with_types", [True, False])
@pytest.mark.parametrize("keypoints", [1, 2, 6, 24, 600])
def test_mutated_headers_fit_no_layout(keypoints: int, with_types: bool) -> None:
    rng = np.random.default_rng(keypoints)
    intact = struct.pack("<Q", 1) + header(48, keypoints) + rng.bytes(48 * keypoints)
    types = [0] if with_types else []
    assert read_blocks(intact, types, keypoints)[0] == DescriptorLayout.BLOCKS
    for _ in range(1000):
        changed = mutated(intact, rng, most=3 if with_types else 2)
        with pytest.raises(MapError):
            read_blocks(changed, types, keypoints)


def test_a_damaged_header_names_file_and_frame(tmp_path: Path) -> None:
    folder = by_hand.reencode(shared_data(SUBMAP), tmp_path / "map", by_hand.THREE_TYPES)
    (path,) = by_hand.vertex_files(folder)
    message = by_hand.read(path)
    frame = message.vertices[4].nframe.frames[0]
    frame.descriptors = frame.descriptors[:16] + b"\x03" + frame.descriptors[17:]
    by_hand.write(path, message)
    with pytest.raises(
        MapError, match=r"vertices0: .*frame \w{32}: descriptor block 0 has depth 3"
    ):
        load_map(folder)


def test_descriptors_of_very_different_sizes_are_bounded(tmp_path: Path) -> None:
    """One descriptor of 16 KiB would make a table of a gigabyte out of some kilobytes."""
    folder = by_hand.reencode(shared_data(SUBMAP), tmp_path / "map", by_hand.ONE_TYPE)
    (path,) = by_hand.vertex_files(folder)
    message = by_hand.read(path)
    frame = message.vertices[0].nframe.frames[0]
    count = len(frame.keypoints_px) // 2
    frame.descriptors = (
        struct.pack("<Q", 2)
        + header(48, count - 1)
        + bytes(48 * (count - 1))
        + header(4096, 1, 5)
        + bytes(16384)
    )
    frame.descriptor_types[:] = [0, 1]
    by_hand.write(path, message)
    with pytest.raises(MapError, match="would take 167 MB of memory; raise --proto_max_size"):
        load_map(folder, max_size_megabytes=100)
    assert load_map(folder, max_size_megabytes=200)[0].keypoints.descriptor.shape[1] == 16384
