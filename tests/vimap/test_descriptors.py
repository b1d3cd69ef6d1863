"""Descriptors of several types, 3D positions and time offsets stay with their keypoints."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from maplab_py.algorithms.keyframing.heuristic import keyframe
from maplab_py.algorithms.keyframing.options import KeyframingOptions
from maplab_py.algorithms.landmarks.options import LandmarkQualityOptions
from maplab_py.algorithms.landmarks.tracks import init_tracks
from maplab_py.algorithms.sparsification.options import SparsificationOptions
from maplab_py.algorithms.sparsification.sparsify import descriptor_deviations, sparsify
from maplab_py.interop.csv_dataset import CsvExportOptions, export_csv_dataset
from maplab_py.storage.native import load_map, save_map
from maplab_py.vimap import VIMap, edits, merge, tables
from maplab_py.vimap.consistency import check_consistency
from maplab_py.vimap.descriptors import DescriptorBlock, binary_blocks, no_blocks, types_of
from maplab_py.vimap.table import object_column
from tests.support import descriptor_blocks as by_hand
from tests.support.data import shared_data
from tests.support.submaps import append_submaps
from tests.vimap.builders import walk_map

SUBMAP = "maplab_maps/euroc_v1_01/euroc_v1_01_submap_{}"
Described = dict[tuple[int, ...], tuple[tuple[int, ...], bytes]]


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    """Two neighbouring submaps with three types of descriptors, positions and offsets."""
    folder = tmp_path_factory.mktemp("marked")
    return {
        number: by_hand.reencode(
            shared_data(SUBMAP.format(number)),
            folder / str(number),
            by_hand.THREE_TYPES,
            marked=True,
        )
        for number in (3, 4)
    }


@pytest.fixture(scope="module")
def marked(folders: dict[int, Path]) -> VIMap:
    return load_map(folders[3])[0]


def check_marks(vi_map: VIMap, described: Described, *, frames: int) -> None:
    """Every keypoint of the marked maps has what the files gave it; so many frames are theirs."""
    table, keypoints = vi_map.frames, vi_map.keypoints
    own = []
    for row, words in enumerate(table.id.byteswap().tolist()):
        if tuple(words) not in described:
            continue
        own.append(row)
        begin = int(vi_map.keypoint_start[row])
        types, data = described[tuple(words)]
        decoded = by_hand.decode(data, types)
        rows = slice(begin, begin + len(decoded))
        assert table.keypoint_count[row] == len(decoded)
        assert vi_map.feature_type[rows].tolist() == [kind for kind, _ in decoded]
        for index, (_, content) in enumerate(decoded, begin):
            assert keypoints.descriptor[index, : len(content)].tobytes() == content
    assert len(own) == frames
    rows = np.flatnonzero(np.isin(vi_map.keypoint_frame, own))
    uv = keypoints.uv_px[rows]
    assert np.array_equal(keypoints.position_3d[rows], by_hand.marks_3d(uv))
    assert np.array_equal(keypoints.time_offset_ns[rows, 0], by_hand.marks_ns(uv))
    bits = tables.FrameField.POSITION_3D | tables.FrameField.TIME_OFFSET
    assert (table.present[own] & bits == bits).all()
    assert check_consistency(vi_map).failure == ""


EDITS: dict[str, Callable[[VIMap], VIMap]] = {
    "keyframing": lambda m: keyframe(m, KeyframingOptions(every_nth_vertex=3))[0],
    "vertex removal": lambda m: edits.remove_vertices(m, np.arange(1, 8)),
    "landmark removal": lambda m: edits.remove_landmarks(m, np.arange(0, 300, 3)),
    "landmark merging": lambda m: edits.merge_landmarks(m, np.arange(20), np.arange(20, 40)),
    "observation removal": lambda m: edits.remove_observations(m, m.observations[::7]),
    "sparsification": lambda m: sparsify(m, 100, SparsificationOptions())[0],
    "merging after": lambda m: merge.merge_maps(m, walk_map())[0],
    "merging before": lambda m: merge.merge_maps(walk_map(), m)[0],
    "mission removal": lambda m: edits.remove_missions(merge.merge_maps(walk_map(), m)[0], [0]),
}


@pytest.mark.parametrize("edit", EDITS)
def test_edits_keep_what_keypoints_carry(
    folders: dict[int, Path], marked: VIMap, tmp_path: Path, edit: str
) -> None:
    described = by_hand.described(folders[3])
    edited = EDITS[edit](marked)
    count = int(np.isin(edited.frames.id[:, 0], marked.frames.id[:, 0]).sum())
    assert 0 < count < len(marked.frames) or edit not in ("keyframing", "vertex removal")
    check_marks(edited, described, frames=count)
    save_map(edited, tmp_path / "map")
    saved = by_hand.described(tmp_path / "map")
    assert {name: saved[name] for name in described if name in saved} == {
        name: described[name] for name in described if name in saved
    }
    check_marks(load_map(tmp_path / "map")[0], described, frames=count)


def test_submaps_keep_what_keypoints_carry(folders: dict[int, Path], tmp_path: Path) -> None:
    described = by_hand.described(folders[3]) | by_hand.described(folders[4])
    joined, report = append_submaps([load_map(folder)[0] for folder in folders.values()])
    assert report.vertices_shared == 1
    check_marks(joined, described, frames=len(described))
    save_map(joined, tmp_path / "map")
    assert by_hand.described(tmp_path / "map") == described


def test_layouts_of_merged_maps_stay_apart(folders: dict[int, Path], tmp_path: Path) -> None:
    legacy = shared_data(SUBMAP.format(4))
    merged, _ = merge.merge_maps(load_map(folders[3])[0], load_map(legacy)[0], assign_new_ids=True)
    layouts = merged.frames.descriptor_layout
    assert (layouts == tables.DescriptorLayout.BLOCKS).sum() == len(load_map(folders[3])[0].frames)
    assert (layouts == tables.DescriptorLayout.LEGACY).sum() == len(load_map(legacy)[0].frames)
    save_map(merged, tmp_path / "map")
    bare = {data for _, data in by_hand.described(legacy).values()}
    assert bare <= {
        data for types, data in by_hand.described(tmp_path / "map").values() if not types
    }


# -- who takes which type -------------------------------------------------------------------------


def with_blocks(vi_map: VIMap, *kinds: tuple[int, int, int]) -> VIMap:
    """Return the map with all descriptors called blocks of (size, depth, feature type)."""
    blocks = [
        tuple(
            DescriptorBlock(count * (part + 1) // len(kinds) - count * part // len(kinds), *kind)
            for part, kind in enumerate(kinds)
        )
        for count in vi_map.frames.keypoint_count.tolist()
    ]
    return vi_map.replace(frames=vi_map.frames.replace(descriptor_blocks=object_column(blocks)))


def test_each_keypoint_knows_its_type_and_size() -> None:
    m = with_blocks(walk_map(), (8, 0, 0), (4, 5, 21))
    first, count = 0, int(m.frames.keypoint_count[0])
    assert m.feature_type[first:count].tolist() == [0] * (count // 2) + [21] * (count - count // 2)
    assert set(m.binary_descriptor_size[m.feature_type == 0]) == {8}
    assert set(m.binary_descriptor_size[m.feature_type == 21]) == {0}
    assert types_of(m.frames) == {0, 21}
    assert types_of(walk_map().frames) == {0}


def test_blocks_that_do_not_fit_are_found() -> None:
    m = walk_map()
    broken = m.frames.replace(descriptor_blocks=binary_blocks(m.frames.keypoint_count + 1, 8))
    report = check_consistency(m.replace(frames=broken))
    assert "descriptors do not fit its keypoints" in report.failure
    with pytest.raises(ValueError, match="do not fit"):
        _ = m.replace(frames=broken).feature_type
    none = m.replace(frames=m.frames.replace(descriptor_blocks=no_blocks(len(m.frames))))
    assert check_consistency(none).failure == ""
    assert (none.feature_type == -1).all()


def test_another_feature_type_than_the_landmarks_is_a_warning() -> None:
    m = with_blocks(walk_map(), (8, 5, 1))
    report = check_consistency(m)
    assert report.failure == ""
    assert [w.rule for w in report.warnings if "feature type" in w.rule] == [
        "landmark of another feature type than a keypoint that observes it"
    ]
    right = m.landmarks.replace(feature_type=np.ones(len(m.landmarks)))
    assert not [
        w for w in check_consistency(m.replace(landmarks=right)).warnings if "type" in w.rule
    ]


def test_landmarks_are_scored_by_their_binary_descriptors() -> None:
    m = walk_map()
    rows = np.arange(len(m.landmarks))
    half = with_blocks(m, (8, 0, 0), (4, 5, 1))
    deviation = descriptor_deviations(half, rows)
    for row in rows:
        mine = m.observations[m.observation_start[row] : m.observation_start[row + 1]]
        mine = mine[half.feature_type[mine] == 0]
        bits = np.unpackbits(m.keypoints.descriptor[mine], axis=1)
        expected = np.mean(bits != (bits.mean(axis=0) > 0.5)) if len(mine) > 1 else 0.0
        assert deviation[row] == pytest.approx(expected)
    assert not descriptor_deviations(with_blocks(m, (8, 5, 1)), rows).any()


def test_tracks_of_one_type_become_landmarks_of_that_type() -> None:
    m = walk_map()
    bare = edits.remove_landmarks(m, np.arange(len(m.landmarks)))
    typed, report = init_tracks(with_blocks(bare, (8, 0, 0), (4, 5, 1)), LandmarkQualityOptions())
    assert report.landmarks_added > 0
    assert set(typed.landmarks.feature_type) == {0, 1}
    kinds = typed.feature_type[typed.observations]
    observed = typed.keypoints.landmark[typed.observations]
    assert np.array_equal(kinds, typed.landmarks.feature_type[observed])


def test_csv_holds_binary_descriptors_and_empty_rows(tmp_path: Path) -> None:
    m = with_blocks(walk_map(), (8, 0, 0), (4, 5, 1))
    export_csv_dataset(m, tmp_path, CsvExportOptions())
    (path,) = tmp_path.rglob("descriptors.csv")
    lines = path.read_text().splitlines()
    assert len(lines) == len(m.keypoints)
    for kind, descriptor, line in zip(m.feature_type, m.keypoints.descriptor, lines, strict=True):
        values = [int(value) for value in line.split(",")] if line else []
        assert values == (descriptor.tolist() if kind == 0 else [])
