"""Loop closure on recorded maps and between simulated sessions: what is there, and nothing else."""

import numpy as np
import pytest
from numpy.typing import NDArray

from maplab_py.algorithms.loop_closure.workflow import search_loops
from maplab_py.geometry import se3, so3
from maplab_py.vimap import VIMap
from tests.algorithms.loop_closure.against_truth import score, sessions
from tests.support.data import shared_data
from tests.support.submaps import append_submaps

pytestmark = pytest.mark.slow


def load(relative: str) -> VIMap:
    native = pytest.importorskip("maplab_py.storage.native")
    return native.load_map(shared_data(f"maplab_maps/{relative}"))[0]


def test_closures_of_the_flight_agree_with_ground_truth():
    submaps = [load(f"euroc_v1_01/euroc_v1_01_submap_{i}") for i in range(8)]
    vi_map, _ = append_submaps(submaps)
    search, report = search_loops(vi_map)
    edges = search.edges
    assert report.accepted_vertices >= 90
    time_s, truth, valid = ground_truth_poses(vi_map)
    position = truth[:, 4:]
    assert valid.sum() >= 148
    distance = np.linalg.norm(position[edges.from_vertex] - position[edges.to_vertex], axis=1)
    known = valid[edges.from_vertex] & valid[edges.to_vertex]
    error = np.abs(np.linalg.norm(edges.T_A_B[:, 4:], axis=1) - distance)[known]
    assert error.max() < 0.3
    assert np.median(error) < 0.05
    # the truth's body may be turned against the IMU: angles of rotations do not mind
    true = se3.relative(truth[edges.from_vertex], truth[edges.to_vertex])
    angle_error = np.rad2deg(np.abs(angle_rad(edges.T_A_B) - angle_rad(true)))[known]
    assert angle_error.max() < 3.0
    assert np.median(angle_error) < 0.7
    assert np.all(np.diff(time_s) > 0)


def angle_rad(T: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.linalg.norm(so3.log(T[:, :4]), axis=1)


def ground_truth_poses(vi_map: VIMap):
    from maplab_py.geometry.interpolation import interpolate_poses

    table = np.loadtxt(shared_data("euroc_imu/V101.gt.csv"), delimiter=",", comments="#")
    poses = se3.make(table[:, [5, 6, 7, 4]], table[:, 1:4])
    time_ns = vi_map.vertices.timestamp_ns
    found, valid = interpolate_poses(table[:, 0].astype(np.int64), poses, time_ns)
    return time_ns * 1e-9, found, valid


@pytest.mark.parametrize(
    ("flips", "vanish", "precision", "recall"), [(0.05, 0.0, 0.995, 0.90), (0.15, 0.3, 0.99, 0.60)]
)
def test_closures_of_four_sessions(flips, vanish, precision, recall):
    vi_map, truth = sessions(flips, vanish, seed=1, rate_hz=3.0, duration_s=40.0)
    search, _ = search_loops(vi_map)
    result = score(vi_map, truth, search.closures)
    assert result.closable > 300
    assert result.accepted > 300
    assert result.precision >= precision
    assert result.recall >= recall
