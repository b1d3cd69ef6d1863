"""Figures show what is in the map: looked up in the artists, and written as real files."""

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maplab_py.algorithms.evaluation.options import TrajectoryEvaluationOptions
from maplab_py.algorithms.evaluation.trajectory_evaluation import evaluate_trajectory
from maplab_py.console.session.session import Session
from maplab_py.errors import EstimationError, UserError
from maplab_py.interop.trajectories import Trajectory
from maplab_py.plotting import maps, time_series
from maplab_py.plotting.figure import check_plot_file, write_figure
from maplab_py.vimap import VIMap, queries
from tests.simulation.small import simulated


@pytest.fixture(scope="module")
def vi_map() -> VIMap:
    return simulated().maps[0]


def shifted_truth(vi_map: VIMap) -> Trajectory:
    T_G_I = vi_map.T_G_I.copy()
    T_G_I[:, 4:] += np.random.default_rng(3).normal(0.0, 0.02, (len(T_G_I), 3)) + 5.0
    return Trajectory(vi_map.vertices.timestamp_ns, T_G_I, source="truth")


def curves(axes: Any) -> list[Any]:
    return [line for line in axes.lines if len(line.get_xdata()) > 1]


def test_trajectories_are_where_the_vertices_are(vi_map: VIMap) -> None:
    (axes,) = maps.trajectories(vi_map, landmarks=False).axes
    (line,) = curves(axes)
    np.testing.assert_array_equal(line.get_xydata(), vi_map.T_G_I[:, 4:6])
    (with_landmarks,) = maps.trajectories(vi_map).axes
    assert len(curves(with_landmarks)) == 2
    assert "1 of unknown base frame" in with_landmarks.get_title()
    (low, high), (bottom, top) = with_landmarks.get_xlim(), with_landmarks.get_ylim()
    x, y = vi_map.T_G_I[:, 4:6].T
    assert low < x.min() < x.max() < high
    assert bottom < y.min() < y.max() < top
    far = np.array(vi_map.landmarks.p_I)
    far[0] = 1e4
    distant = vi_map.replace(landmarks=vi_map.landmarks.replace(p_I=far))
    (with_distant,) = maps.trajectories(distant).axes
    assert with_distant.get_xlim()[1] < 100.0
    with pytest.raises(UserError, match="no vertices"):
        maps.trajectories(VIMap())


def test_truth_is_laid_on_the_vertices(vi_map: VIMap) -> None:
    truth = time_series.truth_in_global_frame(vi_map, shifted_truth(vi_map))
    distance_m = np.linalg.norm(truth - vi_map.T_G_I[:, 4:], axis=1)
    assert np.sqrt(np.mean(distance_m**2)) < 0.05
    (axes,) = maps.trajectories(vi_map, landmarks=False, p_G_truth=truth).axes
    assert len(curves(axes)) == 2


def test_errors_are_those_of_the_evaluation(vi_map: VIMap) -> None:
    options = TrajectoryEvaluationOptions()
    truth = shifted_truth(vi_map)
    figure, rmse_m = time_series.errors_over_time(vi_map, truth, options)
    report = evaluate_trajectory(vi_map, truth, options)
    assert rmse_m == pytest.approx(report.ape_m.rmse, rel=1e-12)
    assert len(curves(figure.axes[0])) == 1
    late = Trajectory(truth.times_ns + 10**15, truth.T_R_B, source="truth")
    with pytest.raises(EstimationError, match="fewer than three"):
        time_series.errors_over_time(vi_map, late, options)


def test_landmark_histograms_count_every_landmark(vi_map: VIMap) -> None:
    by_count, _, by_quality = maps.landmark_histograms(vi_map).axes
    total = sum(patch.get_height() for patch in by_count.patches)
    assert total == len(vi_map.landmarks)
    assert sum(patch.get_height() for patch in by_quality.patches) == len(vi_map.landmarks)
    with pytest.raises(UserError, match="no landmarks"):
        maps.landmark_histograms(VIMap())


def test_coobservability_writes_the_counts(vi_map: VIMap) -> None:
    axes = maps.coobservability(vi_map).axes[0]
    counts = queries.coobservation_counts(vi_map)
    assert [text.get_text() for text in axes.texts] == [str(n) for n in counts.ravel()]


def test_inertial_states(vi_map: VIMap) -> None:
    figure = time_series.inertial_states(vi_map, 0)
    assert [len(curves(axes)) for axes in figure.axes] == [3, 3, 3, 3]
    velocity = curves(figure.axes[1])[2].get_ydata()
    np.testing.assert_array_equal(velocity, vi_map.vertices.v_M[:, 2])


@pytest.mark.parametrize(
    ("suffix", "start"), [(".png", b"\x89PNG"), (".svg", b"<?xml"), (".pdf", b"%PDF")]
)
def test_files(vi_map: VIMap, tmp_path: Path, suffix: str, start: bytes) -> None:
    contents = []
    for name in ("a", "b"):
        path = tmp_path / "new" / f"{name}{suffix}"
        write_figure(time_series.inertial_states(vi_map, 0), path)
        contents.append(path.read_bytes())
    assert contents[0].startswith(start)
    if suffix == ".png":
        assert contents[0] == contents[1]
        assert struct.unpack(">II", contents[0][16:24]) == (1350, 1275)


def test_a_plot_does_not_replace_a_file_unasked(vi_map: VIMap, tmp_path: Path) -> None:
    session = Session()
    session.maps.add("a", vi_map)
    path = tmp_path / "x.png"
    for command in ("plot_landmarks", "plot_trajectory", "plot_coobservability"):
        session.run(command, plot_file=path, overwrite=True)
    with pytest.raises(UserError, match="give --overwrite"):
        session.run("plot_vi_states_of_mission", plot_file=path)
    with pytest.raises(UserError, match="must end in"):
        check_plot_file(Path("x.jpg"), overwrite=False)
    with pytest.raises(UserError, match="cannot be written"):
        write_figure(time_series.inertial_states(vi_map, 0), path / "y.png")
