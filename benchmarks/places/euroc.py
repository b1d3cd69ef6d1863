"""The EuRoC submaps against ground truth and an exhaustive search."""

import dataclasses
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from benchmarks.places.brute_force import FramePairs, search
from maplab_py.algorithms.loop_closure.workflow import search_loops
from maplab_py.geometry import se3, so3
from maplab_py.geometry.alignment import umeyama
from maplab_py.vimap import VIMap
from tests.algorithms.loop_closure.test_real_maps import ground_truth_poses, load
from tests.support.submaps import append_submaps

WRONG_M, WRONG_DEG = 0.3, 3.0
MIN_TIME_S = 10.0


@dataclasses.dataclass(frozen=True)
class EurocFigures:
    """Closures of lc, and the vertices that an exhaustive search closes."""

    vertices: int
    min_inliers: int  # of a pair of the exhaustive search
    brute_pairs: int
    brute_wrong: float  # part of the pairs that are off by more than 0.3 m or 3 deg
    brute_vertices: int  # with a pair that is right
    found: int  # of these, with an accepted closure that is right
    recall: float
    closures: int
    closures_judged: int  # both ends have a ground truth
    closures_wrong: int
    largest_m: float
    largest_deg: float


def measure(query_step: int = 3) -> Iterator[EurocFigures]:
    """Compare every third vertex with all, at several limits of inliers."""
    vi_map, pairs = _flight(query_step)
    for min_inliers in (12, 15, 20, 30):
        yield _figures(vi_map, pairs, min_inliers)


def compare(query_step: int, min_inliers: int = 12) -> EurocFigures:
    """Compare with an exhaustive search for some of the vertices only."""
    return _figures(*_flight(query_step), min_inliers)


def _flight(query_step: int) -> tuple[VIMap, FramePairs]:
    """Return the flight as one mission, and pairs of frames by exhaustive search."""
    vi_map, _ = append_submaps([load(f"euroc_v1_01/euroc_v1_01_submap_{i}") for i in range(8)])
    every = np.arange(len(vi_map.vertices))
    return vi_map, search(vi_map, every[::query_step], every, min_time_s=MIN_TIME_S)


def _figures(vi_map: VIMap, pairs: FramePairs, min_inliers: int) -> EurocFigures:
    truth, has_truth = _truth(vi_map)
    c = search_loops(vi_map)[0].closures
    c = c.take(np.flatnonzero(c.accepted))
    judged = has_truth[c.query_vertex] & has_truth[c.place_vertex]
    far_m, far_deg = _error(truth, c.query_vertex, c.place_vertex, c.T_A_B)
    is_right = ~judged | ((far_m <= WRONG_M) & (far_deg <= WRONG_DEG))
    closed = np.zeros(len(vi_map.vertices), dtype=np.bool_)
    closed[c.query_vertex[is_right]] = True
    pairs = pairs.take(has_truth[pairs.query] & has_truth[pairs.place])
    pairs = pairs.take(pairs.inliers >= min_inliers)
    pair_m, pair_deg = _error(truth, pairs.query, pairs.place, pairs.T_A_B(vi_map))
    wrong = (pair_m > WRONG_M) | (pair_deg > WRONG_DEG)
    brute = np.unique(pairs.query[~wrong])
    found = int(closed[brute].sum())
    return EurocFigures(
        vertices=len(vi_map.vertices),
        min_inliers=min_inliers,
        brute_pairs=len(pairs),
        brute_wrong=float(wrong.mean()),
        brute_vertices=len(brute),
        found=found,
        recall=found / len(brute),
        closures=len(c),
        closures_judged=int(judged.sum()),
        closures_wrong=int((~is_right).sum()),
        largest_m=float(far_m[judged].max()),
        largest_deg=float(far_deg[judged].max()),
    )


def _truth(vi_map: VIMap) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return true poses of the IMU (V, 7), and which vertices have one.

    The truth's body is turned against the IMU by a constant; it follows from the map's own attitudes
    over short times, where they are right: the mean turn that makes relative attitudes agree.
    """
    _, body, valid = ground_truth_poses(vi_map)
    T_G_I = vi_map.T_G_I
    # align positions first, then take the mean of what is left between the two attitudes
    T_true_G, _ = umeyama(body[valid, 4:], T_G_I[valid, 4:])
    q = so3.multiply(T_true_G[:4], T_G_I[valid, :4])
    left = so3.to_matrix(so3.multiply(so3.inverse(body[valid, :4]), q))
    U, _, Vt = np.linalg.svd(left.mean(axis=0))
    R_body_I = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    T_body_I = se3.make(so3.from_matrix(R_body_I), np.zeros(3))
    return se3.compose(body, T_body_I), valid


def _error(
    truth: NDArray[np.float64],
    a: NDArray[np.int64],
    b: NDArray[np.int64],
    T_A_B: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return errors [m] and [deg] (N,) of relative poses."""
    error = se3.local(se3.relative(truth[a], truth[b]), T_A_B)
    return np.linalg.norm(error[:, :3], axis=1), np.degrees(np.linalg.norm(error[:, 3:], axis=1))
