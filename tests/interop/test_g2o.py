from __future__ import annotations

import gzip

import numpy as np
import pytest

from maplab_py.algorithms.relaxation.graph_files import is_odometry, map_of_graph
from maplab_py.errors import MapError, UserError
from maplab_py.geometry import se3, so3
from maplab_py.interop.g2o import PoseGraph, read_g2o, write_g2o

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
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 x\n", "1: could not convert"),
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


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(MapError, match=r"cannot read .*nowhere\.g2o"):
        read_g2o(tmp_path / "nowhere.g2o")


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
