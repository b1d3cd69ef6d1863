from __future__ import annotations

import numpy as np
import pytest

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
    ids = np.array([3, 4, 5, (97 << 56) + 1])
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
        ("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 0 0 0 0\n", "pose 0 is there twice"),
        (f"VERTEX_SE2 0 0 0 0\nEDGE_SE3:QUAT 0 7 0 0 0 0 0 0 1 {IDENTITY}\n", "pose 7"),
        ("", "no poses"),
    ],
)
def test_errors_name_file_and_line(tmp_path, text, message):
    path = tmp_path / "bad.g2o"
    path.write_text(text)
    with pytest.raises(MapError, match=message) as caught:
        read_g2o(path)
    assert "bad.g2o" in str(caught.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(MapError, match=r"cannot read .*nowhere\.g2o"):
        read_g2o(tmp_path / "nowhere.g2o")
