"""maplab's CSV data set and G2O graphs, read back without the product."""

import dataclasses
import gzip
from pathlib import Path

import numpy as np
import pytest

from maplab_py.algorithms.relaxation.graph_files import is_odometry, map_of_graph
from maplab_py.errors import MapError, UserError
from maplab_py.geometry import se3, so3
from maplab_py.interop.csv_dataset import CsvExportOptions, export_csv_dataset
from maplab_py.interop.g2o import PoseGraph, read_g2o, write_g2o
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


IDENTITY = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"


def small_graph() -> PoseGraph:
    rng = np.random.default_rng(0)
    T = se3.make(so3.exp(rng.normal(size=(4, 3))), rng.normal(size=(4, 3)))
    first, second = np.array([0, 1, 2, 0]), np.array([1, 2, 3, 3])
    root = rng.normal(size=(4, 6, 6))
    information = root @ root.transpose(0, 2, 1) + np.eye(6)
    ids = np.array([3, 4, 5, (97 << 56) + 1], dtype=np.uint64)
    measured = se3.relative(T[first], T[second])
    return PoseGraph(ids, T, first, second, measured, information, np.array([2]))


def test_a_graph_comes_back_exactly(tmp_path):
    graph, path = small_graph(), tmp_path / "graph.g2o"
    write_g2o(graph, path)
    again = read_g2o(path)
    for name in ("id", "first", "second", "fixed"):
        np.testing.assert_array_equal(getattr(again, name), getattr(graph, name))
    for name in ("T_G_V", "T_A_B", "information"):
        np.testing.assert_allclose(
            getattr(again, name), getattr(graph, name), rtol=1e-15, atol=1e-15
        )
    with pytest.raises(UserError, match="exists"):
        write_g2o(graph, path)


def test_planar_poses_and_edges_lie_in_the_plane(tmp_path):
    path = tmp_path / "planar.g2o"
    path.write_text(
        "VERTEX_SE2 1 2 3 0.5\nVERTEX_SE2 0 0 0 0\n# a comment\n\n"
        "EDGE_SE2 0 1 2 3 0.5 10 1 2 20 3 30\n"
    )
    graph = read_g2o(path)
    assert graph.id.tolist() == [0, 1]
    np.testing.assert_allclose(graph.T_G_V[1, 4:], [2.0, 3.0, 0.0])
    np.testing.assert_allclose(so3.log(graph.T_A_B[0, :4]), [0.0, 0.0, 0.5])
    planar = graph.information[0][np.ix_([0, 1, 5], [0, 1, 5])]
    np.testing.assert_array_equal(planar, [[10, 1, 2], [1, 20, 3], [2, 3, 30]])
    assert np.linalg.eigvalsh(graph.information[0])[0] > 0.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0\n", "1: VERTEX_SE3:QUAT has 7 numbers, not 8"),
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 x\n", "1: 'x' is not a number"),
        ("VERTEX_XY 0 0 0\n", "1: 'VERTEX_XY' is not among"),
        ("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 0 0 0 0\n", "pose 0 occurs twice"),
        (f"VERTEX_SE2 0 0 0 0\nEDGE_SE3:QUAT 0 7 0 0 0 0 0 0 1 {IDENTITY}\n", "pose 7"),
        ("", "no poses"),
        ("VERTEX_SE2 -1 0 0 0\n", r":1: '-1' is not an id"),
        (
            "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 18446744073709551616 0 0 0\n",
            r":2: '18446744073709551616' is not",
        ),
        ("VERTEX_SE2 1.0 0 0 0\n", r":1: '1.0' is not an id"),
        ("VERTEX_SE2 0 0 0 nan\n", r":1: a value is not a finite number"),
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 0\n", r":1: the quaternion is zero"),
        ("VERTEX_SE2 0 0 0 0\nFIX x\n", r":2: 'x' is not an id"),
    ],
)
def test_errors_name_file_and_line(tmp_path, text, message):
    path = tmp_path / "bad.g2o"
    path.write_text(text)
    with pytest.raises(MapError, match=message) as caught:
        read_g2o(path)
    assert "bad.g2o" in str(caught.value)


@pytest.mark.parametrize("highest", [(1 << 63) + 1, (1 << 64) - 1])
def test_ids_have_64_bits_without_sign(tmp_path, highest):
    path, again = tmp_path / "a.g2o", tmp_path / "b.g2o"
    path.write_text(
        f"VERTEX_SE2 {highest - 1} 0 0 0\nVERTEX_SE2 {highest} 1 0 0\nVERTEX_SE2 7 1 0 0\n"
        f"FIX {highest} 7\nFIX\nEDGE_SE2 {highest - 1} {highest} 1 0 0 1 0 0 1 0 1\n"
    )
    graph = read_g2o(path)
    assert graph.id.tolist() == [7, highest - 1, highest]
    assert graph.fixed.tolist() == [0, 2]
    assert is_odometry(graph).tolist() == [True]
    write_g2o(graph, again)
    assert read_g2o(again).id.tolist() == graph.id.tolist()
    assert len(map_of_graph(graph).transformation_edges) == 1


def test_parameters_of_other_edges_are_skipped(tmp_path):
    path, plain = tmp_path / "a.g2o", tmp_path / "b.g2o"
    write_g2o(small_graph(), plain)
    path.write_text("PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1\n" + plain.read_text())
    assert read_g2o(path).id.tolist() == small_graph().id.tolist()


def test_compressed_files_are_unpacked(tmp_path):
    graph, path = small_graph(), tmp_path / "graph.g2o"
    write_g2o(graph, path)
    packed = tmp_path / "graph.g2o.gz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    again = read_g2o(packed)
    np.testing.assert_array_equal(again.T_G_V, read_g2o(path).T_G_V)
    assert again.num_repaired == 0
    packed.write_bytes(packed.read_bytes()[:-20])
    with pytest.raises(MapError, match=r"graph\.g2o\.gz: is damaged"):
        read_g2o(packed)


def test_edges_alone_give_the_poses_along_the_odometry(tmp_path):
    rng = np.random.default_rng(3)
    T = se3.make(so3.exp(rng.normal(size=(9, 3))), rng.normal(size=(9, 3)))
    # poses 0 .. 4 in a chain, closed by a wrong edge; 7 and 8 of another part, 5 and 6 by edges backwards
    first, second = np.array([0, 1, 2, 3, 0, 7, 5, 6, 3]), np.array([1, 2, 3, 4, 3, 8, 1, 5, 3])
    measured = se3.relative(T[first], T[second])
    measured[4, 4:] += 5.0
    information = np.tile(np.eye(6), (9, 1, 1))
    path = tmp_path / "edges.g2o"
    graph = PoseGraph(
        np.arange(9, dtype=np.uint64),
        T,
        first,
        second,
        measured,
        information,
        np.zeros(0, dtype=np.int64),
    )
    write_g2o(graph, path)
    lines = [line for line in path.read_text().splitlines() if line.startswith("EDGE")]
    path.write_text("\n".join(lines))
    again = read_g2o(path)
    assert again.id.tolist() == list(range(9))
    np.testing.assert_allclose(
        se3.relative(again.T_G_V[[0] * 7], again.T_G_V[:7])[:, 4:],
        se3.relative(T[[0] * 7], T[:7])[:, 4:],
        atol=1e-12,
    )
    np.testing.assert_allclose(again.T_G_V[[0, 7]], se3.identity(2))
    kept = se3.relative(again.T_G_V[[7]], again.T_G_V[[8]])
    np.testing.assert_allclose(kept[:, 4:], measured[[5], 4:], atol=1e-12)


def test_information_that_is_not_positive_definite_is_repaired(tmp_path):
    graph, path = small_graph(), tmp_path / "graph.g2o"
    information = graph.information.copy()
    value, vector = np.linalg.eigh(information[1])
    value[:2] = -1e-3, 0.0
    information[1] = (vector * value) @ vector.T
    write_g2o(PoseGraph(**{**vars(graph), "information": information}), path)
    again = read_g2o(path)
    assert again.num_repaired == 1
    np.testing.assert_array_equal(again.information[[0, 2, 3]], graph.information[[0, 2, 3]])
    repaired = np.linalg.eigvalsh(again.information[1])
    np.testing.assert_allclose(repaired[2:], value[2:], rtol=1e-9)
    np.testing.assert_allclose(repaired[:2], 1e-9 * value[-1], rtol=1e-3)
    np.linalg.cholesky(again.information)
