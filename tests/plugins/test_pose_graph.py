"""Pose graphs of other programs, and commands on edges, vertices and missions, through the session."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from maplab_py.algorithms.loop_closure.workflow import search_loops
from maplab_py.console.session.session import Session
from maplab_py.errors import FlagError, MapError, UserError
from maplab_py.geometry import se3
from tests.algorithms.loop_closure.rooms import Walk, make_map
from tests.vimap.builders import walk_map

TWICE = [Walk(room=1), Walk(room=1, start_s=60.0, drift=(0.2, -0.1, 0.05, 0.01))]


@pytest.fixture
def session() -> Session:
    session = Session()
    session.maps.add("rooms", make_map(TWICE)[0])
    return session


def pose(T: np.ndarray) -> dict[str, list[float]]:
    return {"rotation_xyzw": T[:4].tolist(), "translation_m": T[4:].tolist()}


def external(session: Session, path: Path, late_ns: int = 0) -> int:
    """Write the closures that lc would find, seen from poses a little beside the vertices."""
    vi_map = session.vi_map
    edges = search_loops(vi_map)[0].edges
    beside = se3.make([0.0, 0.0, 0.1, np.sqrt(0.99)], [0.3, 0.1, -0.2])
    entries = []
    for a, b, T_A_B in zip(edges.from_vertex, edges.to_vertex, edges.T_A_B, strict=True):
        T_S_T = se3.compose(se3.compose(se3.inverse(beside), T_A_B), beside)
        ends = {
            name: {
                "timestamp_ns": int(vi_map.vertices.timestamp_ns[v]) + 5_000_000 + late_ns,
                "pose": pose(se3.compose(vi_map.T_G_I[v], beside)),
            }
            for name, v in (("camera_from", a), ("camera_to", b))
        }
        entries.append(
            {
                **ends,
                "T_from_to": pose(T_S_T),
                "covariance": (np.eye(6) * 1e-4).ravel().tolist(),
                "switch_variable": 1.0,
                "switch_variable_variance": 1e-8,
            }
        )
    path.write_text(yaml.safe_dump(entries))
    return len(entries)


def test_external_closures_relax_as_found_ones_do(session: Session, tmp_path: Path) -> None:
    count = external(session, tmp_path / "closures.yaml")
    truth = make_map(TWICE)[1]
    report = session.run(
        "relax_external", relax_external_loop_closures_file=tmp_path / "closures.yaml"
    )
    assert report.num_loop_closures == count
    assert report.notes == ()
    after = np.linalg.norm(session.vi_map.T_G_I[:, 4:] - truth[:, 4:], axis=1).max()
    assert after < 0.1
    assert len(session.vi_map.loop_closure_edges) == 0


def test_entries_without_a_vertex_are_told(session: Session, tmp_path: Path) -> None:
    external(session, tmp_path / "closures.yaml", late_ns=100_000_000)
    report = session.run(
        "relax_external", relax_external_loop_closures_file=tmp_path / "closures.yaml"
    )
    assert "no loop closure edges" in report.failure
    assert "without a vertex within 20 ms" in report.notes[0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{}", "a list"),
        ("[{}]", "entry 1: 'camera_from' is missing"),
        (
            "[{camera_from: {timestamp_ns: 1, pose: {rotation_xyzw: [0], translation_m: [1]}}}]",
            "4 numbers",
        ),
        ("[", "not valid YAML"),
    ],
)
def test_wrong_files_are_errors(session: Session, tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "bad.yaml").write_text(text)
    with pytest.raises(MapError, match=message):
        session.run("relax_external", relax_external_loop_closures_file=tmp_path / "bad.yaml")
    with pytest.raises(UserError, match="--relax_external_loop_closures_file"):
        session.run("relax_external")


@pytest.fixture
def walk_session() -> Session:
    walk_session = Session()
    walk_session.maps.add("walk", walk_map())
    return walk_session


def test_sigmas_must_be_given(walk_session: Session) -> None:
    with pytest.raises(FlagError, match="translation_std_dev_meters"):
        walk_session.run("assign_edge_uncertainties", edge_type="odometry")
