"""Single fields of the file format: what is optional, what is written, what leads nowhere."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import MapError
from maplab_py.storage import maplab_map_pb2 as pb
from maplab_py.storage.native import load_map, save_map
from maplab_py.storage.protobuf.map_files import read_unpacked
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
    assert read_unpacked(path, 1000) == bytes(1000)
    with pytest.raises(MapError, match="--proto_max_size_megabytes"):
        read_unpacked(path, 999)


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
