"""The evaluation command, called as a function and through its flags."""

from pathlib import Path

import numpy as np
import pytest

from maplab_py.console.session.session import Session
from maplab_py.errors import EstimationError, MapError, UserError
from maplab_py.interop.trajectories import Trajectory, write_euroc
from tests.interop.small_map import make_map


@pytest.fixture
def session() -> Session:
    session = Session()
    session.maps.add("small", make_map())
    return session


def write_truth(path: Path, session: Session) -> Path:
    vi_map = session.vi_map
    write_euroc(Trajectory(vi_map.vertices.timestamp_ns, vi_map.T_G_I), path)
    return path


def test_wrong_requests(tmp_path: Path, session: Session) -> None:
    with pytest.raises(MapError, match=r"cannot read .*absent"):
        session.run("evaluate_trajectory", ground_truth=tmp_path / "absent.csv")
    with pytest.raises(UserError, match="ground_truth"):
        session.run("evaluate_trajectory")
    truth = write_truth(tmp_path / "truth.csv", session)
    with pytest.raises(UserError, match="alignment"):
        session.run("evaluate_trajectory", ground_truth=truth, alignment="affine")
    early = Trajectory(np.array([1, 2]), session.vi_map.T_G_I[:2])
    write_euroc(early, tmp_path / "early.csv")
    with pytest.raises(EstimationError, match="only 0 of 12 vertices"):
        session.run("evaluate_trajectory", ground_truth=tmp_path / "early.csv")


def test_the_second_evaluation_shows_the_difference_to_the_first(
    tmp_path: Path, session: Session
) -> None:
    vi_map = session.vi_map
    T_R_B = vi_map.T_G_I.copy()
    T_R_B[:, 4:] += np.random.default_rng(1).normal(0.0, 0.1, (len(T_R_B), 3))
    write_euroc(Trajectory(vi_map.vertices.timestamp_ns, T_R_B), tmp_path / "truth.csv")
    session.run("snapshot", "start")
    first = session.run("evaluate_trajectory", str(tmp_path / "truth.csv"))
    assert first.baseline is None
    assert [line.change for line in first.display().errors] == [""] * len(first.display().errors)
    T_M_I = vi_map.vertices.T_M_I.copy()
    T_M_I[:, 4] *= 1.5
    moved = vi_map.replace(vertices=vi_map.vertices.replace(T_M_I=T_M_I))
    session.maps.update(session.maps.selected.with_value(moved, "test"))
    second = session.run("evaluate_trajectory", ground_truth=tmp_path / "truth.csv")
    assert second.baseline.name == "the last evaluation"
    assert second.baseline.ape_m == first.ape_m.rmse
    difference = second.ape_m.rmse - first.ape_m.rmse
    assert second.display().errors[0].change.startswith(f"{difference:+.4f} (")
    with_snapshot = session.run(
        "evaluate_trajectory", ground_truth=tmp_path / "truth.csv", baseline="start"
    )
    assert with_snapshot.baseline.ape_m == pytest.approx(first.ape_m.rmse)
    other = session.run("evaluate_trajectory", ground_truth=tmp_path / "truth.csv", alignment="yaw")
    assert other.baseline is None
    with pytest.raises(UserError, match="no snapshot 'end'"):
        session.run("evaluate_trajectory", ground_truth=tmp_path / "truth.csv", baseline="end")
