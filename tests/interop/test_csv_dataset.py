"""maplab's CSV data set, read back with numpy alone."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import UserError
from maplab_py.interop.csv_dataset import CsvExportOptions, export_csv_dataset
from maplab_py.vimap import ids
from tests.interop.small_map import START_NS, VERTICES, make_map

FILES = ["descriptors", "imu", "landmarks", "observations", "tracks", "vertices"]


def table(folder: Path, name: str) -> np.ndarray:
    skip = 0 if name == "descriptors" else 1
    return np.loadtxt(folder / f"{name}.csv", delimiter=",", skiprows=skip, ndmin=2)


@pytest.fixture
def exported(tmp_path: Path):
    vi_map = make_map()
    options = CsvExportOptions(absolute_time=True)
    report = export_csv_dataset(vi_map, tmp_path / "csv", options)
    folders = [tmp_path / "csv" / text for text in ids.to_hex_list(vi_map.missions.id)]
    return vi_map, folders, report


def test_every_mission_has_every_file(exported) -> None:
    _, folders, report = exported
    for folder in folders:
        assert sorted(path.name for path in folder.iterdir()) == [f"{name}.csv" for name in FILES]
    assert (report.missions, report.files, report.vertices) == (2, 12, 12)
    assert report.keypoints == 48
    assert report.observations == 36


def test_vertices_are_in_the_global_frame(exported) -> None:
    vi_map, folders, _ = exported
    for mission, folder in enumerate(folders):
        rows = slice(mission * VERTICES, (mission + 1) * VERTICES)
        data = table(folder, "vertices")
        assert data[:, 0].tolist() == list(range(VERTICES))
        assert np.array_equal(data[:, 2:5], vi_map.T_G_I[rows, 4:])
        assert np.array_equal(data[:, 5:9], vi_map.T_G_I[rows, :4])
        assert np.array_equal(data[:, 9:12], vi_map.vertices.v_M[rows])
        assert np.array_equal(data[:, 12:15], vi_map.vertices.accel_bias[rows])
        assert np.array_equal(data[:, 15:18], vi_map.vertices.gyro_bias[rows])
        first = (folder / "vertices.csv").read_text().splitlines()[1]
        assert first.split(", ")[1] == str(START_NS + mission * 10**11)


def test_shared_imu_samples_are_written_once(exported) -> None:
    vi_map, folders, _ = exported
    data = table(folders[0], "imu")
    assert data.shape == ((VERTICES - 1) * 50 + 1, 7)
    assert np.array_equal(data[:51, 1:], vi_map.imu_samples.accel_gyro[:51])


def test_tracks_and_descriptors_run_in_parallel(exported) -> None:
    vi_map, folders, _ = exported
    for mission, width in ((0, 48), (1, 3)):
        tracks, descriptors = (
            table(folders[mission], "tracks"),
            table(folders[mission], "descriptors"),
        )
        rows = slice(mission * 24, (mission + 1) * 24)
        assert np.array_equal(tracks[:, 4:6], vi_map.keypoints.uv_px[rows])
        assert tracks[:, 1].tolist() == np.repeat(np.arange(VERTICES), 4).tolist()
        assert tracks[:, 3].tolist() == [0, 1, 2, 3] * VERTICES
        assert tracks[:, 8].tolist() == vi_map.keypoints.track_id[rows].tolist()
        assert np.array_equal(descriptors, vi_map.keypoints.descriptor[rows, :width])


def test_every_observation_finds_its_landmark(exported) -> None:
    vi_map, folders, _ = exported
    for mission, wanted in ((0, [0, 1, 2]), (1, [2, 3, 4])):
        landmarks = table(folders[mission], "landmarks")
        observations = table(folders[mission], "observations").astype(int)
        assert np.array_equal(landmarks[:, 1:], vi_map.p_G[wanted])
        assert len(observations) == 18
        row = mission * 24 + observations[:, 0] * 4 + observations[:, 2]
        observed = np.array(wanted)[observations[:, 3]]
        assert np.array_equal(vi_map.keypoints.landmark[row], observed)


def test_only_good_landmarks(tmp_path: Path) -> None:
    options = CsvExportOptions(only_high_quality_landmarks=True)
    vi_map = make_map()
    report = export_csv_dataset(vi_map, tmp_path, options, missions=np.array([1]))
    folder = tmp_path / ids.to_hex(vi_map.missions.id[1])
    assert (report.missions, report.landmarks, report.observations) == (1, 1, 6)
    assert table(folder, "landmarks").shape == (1, 4)
    assert np.all(table(folder, "observations")[:, 3] == 0)


def test_times_are_relative_unless_asked(tmp_path: Path) -> None:
    vi_map = make_map()
    export_csv_dataset(vi_map, tmp_path, CsvExportOptions(), missions=np.array([1]))
    folder = tmp_path / ids.to_hex(vi_map.missions.id[1])
    assert table(folder, "vertices")[0, 1] == 0
    assert table(folder, "imu")[0, 0] == 0
    assert table(folder, "tracks")[4, 0] == 500_000_000


def test_nothing_is_written_when_one_file_exists(tmp_path: Path) -> None:
    vi_map = make_map()
    folder = tmp_path / ids.to_hex(vi_map.missions.id[1])
    folder.mkdir()
    (folder / "imu.csv").write_text("mine")
    with pytest.raises(UserError, match=r"imu\.csv exists already: give --overwrite"):
        export_csv_dataset(vi_map, tmp_path, CsvExportOptions())
    assert [path.name for path in tmp_path.rglob("*.csv")] == ["imu.csv"]
    export_csv_dataset(vi_map, tmp_path, CsvExportOptions(), overwrite=True)
    assert (folder / "imu.csv").read_text() != "mine"


@pytest.mark.parametrize("name", ["vertices", "imu_data", "tracks_and_keypoints", "landmarks"])
def test_tables_can_be_left_out(tmp_path: Path, name: str) -> None:
    options = dataclasses.replace(CsvExportOptions(), **{name: False})
    assert export_csv_dataset(make_map(), tmp_path, options).files == 10


class FirstTwoBytes:
    """Stands for a projection: halves of the first two bytes of descriptors of 48 bytes."""

    descriptor_size = 48

    def project(self, descriptors: np.ndarray) -> np.ndarray:
        assert descriptors.shape[1] == self.descriptor_size
        return (descriptors[:, :2] / np.float32(3.0)).astype(np.float32)


def test_projected_descriptors_are_read_back_exactly(tmp_path: Path) -> None:
    vi_map = make_map()
    export_csv_dataset(vi_map, tmp_path, CsvExportOptions(), projector=FirstTwoBytes())
    first, second = (tmp_path / text for text in ids.to_hex_list(vi_map.missions.id))
    lines = (first / "descriptors.csv").read_text().splitlines()
    read = np.array([line.split(", ") for line in lines], dtype=np.float32)
    expected = FirstTwoBytes().project(vi_map.keypoints.descriptor[:24, :48])
    assert np.array_equal(read, expected)
    # descriptors of another length than the projection takes have an empty row
    assert (second / "descriptors.csv").read_text() == "\n" * 24
