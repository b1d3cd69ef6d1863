"""The summary map file: what is written is read, other programs' files too, damage is named."""

import dataclasses
import gzip
from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import MapError, UserError
from maplab_py.storage import maplab_map_pb2 as pb
from maplab_py.storage.summary_map import (
    FILE_NAME,
    SummaryMap,
    read_summary_map,
    summary_map_file,
    write_summary_map,
)
from tests.vimap.builders import sensors


def make(landmarks: int = 7, observers: int = 3, observations: int = 20) -> SummaryMap:
    rng = np.random.default_rng(0)
    half = rng.normal(size=(landmarks, 3, 3))
    return SummaryMap(
        p_G=rng.normal(size=(landmarks, 3)).astype(np.float32),
        p_G_observer=rng.normal(size=(observers, 3)).astype(np.float32),
        descriptors=rng.normal(size=(observations, 10)).astype(np.float32),
        landmark=np.sort(rng.integers(0, landmarks, observations)).astype(np.uint32),
        observer=rng.integers(0, observers, observations).astype(np.uint32),
        landmark_id=rng.integers(1, 2**63, (landmarks, 2), dtype=np.uint64),
        observer_id=rng.integers(1, 2**63, (observers, 2), dtype=np.uint64),
        landmark_covariance=(half @ half.transpose(0, 2, 1)).astype(np.float32),
        projection=rng.normal(size=(10, 64)).astype(np.float32),
        sensors=sensors(),
        existence_percent=rng.integers(0, 101, landmarks).astype(np.uint8),
    )


def message_of(path: Path) -> pb.LocalizationSummaryMap:
    message = pb.LocalizationSummaryMap()
    message.ParseFromString(gzip.decompress(path.read_bytes()))
    return message


def rewrite(path: Path, message: pb.LocalizationSummaryMap) -> None:
    path.write_bytes(gzip.compress(message.SerializeToString()))


def test_what_is_written_is_read(tmp_path: Path) -> None:
    summary = make()
    path = write_summary_map(summary, tmp_path / "summary")
    assert path.name == FILE_NAME
    assert summary_map_file(tmp_path / "summary") == path == summary_map_file(path)
    for place in (path, path.parent):
        read = read_summary_map(place)
        for field in dataclasses.fields(SummaryMap):
            if field.name not in ("sensors", "descriptor_kind"):
                left, right = getattr(read, field.name), getattr(summary, field.name)
                np.testing.assert_allclose(left, right, rtol=1e-6)
        assert read.descriptor_kind is None
        assert read.sensors is not None
        assert set(read.sensors.sensors) == set(sensors().sensors)


def test_the_fields_of_maplab_are_where_maplab_looks(tmp_path: Path) -> None:
    summary = make()
    message = message_of(write_summary_map(summary, tmp_path))
    inner = message.uncompressed_map
    np.testing.assert_array_equal(np.reshape(message.p_G_landmark, (-1, 3)), summary.p_G)
    assert (inner.descriptors.rows, inner.descriptors.cols) == (10, 20)
    # column-major: the first ten numbers are the first descriptor
    np.testing.assert_array_equal(inner.descriptors.data[:10], summary.descriptors[0])
    assert list(inner.observation_to_landmark_index) == summary.landmark.tolist()
    assert list(inner.observer_indices) == summary.observer.tolist()


def test_a_file_of_another_program_is_read_without_extras(tmp_path: Path) -> None:
    path = write_summary_map(make(), tmp_path)
    message = message_of(path)
    message.ClearField("extras")
    rewrite(path, message)
    read = read_summary_map(path)
    assert read.landmark_id is None
    assert read.projection is None
    np.testing.assert_array_equal(read.p_G, make().p_G)


def test_damage_is_named(tmp_path: Path) -> None:
    path = write_summary_map(make(), tmp_path)
    whole = path.read_bytes()
    path.write_bytes(whole[:-30])
    with pytest.raises(MapError, match=FILE_NAME):
        read_summary_map(path)
    path.write_bytes(whole)
    message = message_of(path)
    message.p_G_landmark[4] += 0.5
    rewrite(path, message)
    with pytest.raises(MapError, match="checksum"):
        read_summary_map(path)
    message.uncompressed_map.observer_indices[0] = 99
    rewrite(path, message)
    with pytest.raises(MapError, match="beyond the 3"):
        read_summary_map(path)
    message.p_G_landmark.pop()
    rewrite(path, message)
    with pytest.raises(MapError, match="not points"):
        read_summary_map(path)
    with pytest.raises(MapError, match="no file"):
        read_summary_map(tmp_path / "elsewhere")


def test_nothing_is_overwritten_unasked(tmp_path: Path) -> None:
    path = write_summary_map(make(), tmp_path)
    before = path.read_bytes()
    with pytest.raises(UserError, match="overwrite"):
        write_summary_map(make(landmarks=8), tmp_path)
    assert path.read_bytes() == before
    write_summary_map(make(landmarks=8), tmp_path, overwrite=True)
    assert len(read_summary_map(path).p_G) == 8
    assert [p.name for p in tmp_path.iterdir()] == [FILE_NAME]


def test_equal_maps_give_equal_bytes(tmp_path: Path) -> None:
    a, b = (write_summary_map(make(), tmp_path / name) for name in "ab")
    assert a.read_bytes() == b.read_bytes()
