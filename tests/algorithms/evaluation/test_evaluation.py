"""APE and RPE against evo's numbers, vertices against ground truth, and two maps compared."""

import csv
import dataclasses
from pathlib import Path

import numpy as np
import pytest

from maplab_py.algorithms.evaluation import map_comparison, pose_errors
from maplab_py.algorithms.evaluation.options import TrajectoryEvaluationOptions
from maplab_py.algorithms.evaluation.trajectory_evaluation import evaluate_trajectory, match
from maplab_py.errors import EstimationError, FlagError
from maplab_py.geometry import se3, so3
from maplab_py.interop.trajectories import Trajectory, read_trajectory
from maplab_py.vimap import BaseFrames, LandmarkQuality, Missions, Vertices, VIMap, ids
from tests.interop.small_map import make_map
from tests.support.association import associate
from tests.support.data import shared_data

FILES = {
    "euroc": ("V102_groundtruth.csv", "V102.txt"),
    "tum": ("freiburg1_xyz-groundtruth.txt", "freiburg1_xyz-rgbdslam.txt"),
}


GOLDEN = {
    name: tuple(map(float, numbers))
    for name, *numbers in csv.reader(Path(__file__).with_name("golden_evo.csv").open())
}
"""Errors of evo 1.38 on its own test data: rmse, mean, median, std, min, max, count."""
SCALE = {"euroc": 0.9796982521745786, "tum": 1.0080013899313378}


def matched(name: str) -> tuple[np.ndarray, np.ndarray]:
    truth, estimate = (
        read_trajectory(shared_data(f"trajectories/{f}"), keep_repeated=True) for f in FILES[name]
    )
    i, j = associate(truth.times_ns, estimate.times_ns, 10_000_000, one_to_one=False)
    return truth.T_R_B[i], estimate.T_R_B[j]


def check(errors: np.ndarray, golden: tuple[float, ...]) -> None:
    s = pose_errors.statistics(errors)
    assert s.count == golden[6]
    assert [s.rmse, s.mean, s.median, s.std, s.min, s.max] == pytest.approx(
        golden[:6], abs=1e-9, rel=0.0
    )


@pytest.mark.parametrize("name", list(FILES))
@pytest.mark.parametrize("alignment", ["none", "se3", "sim3"])
def test_ape_is_evos(name: str, alignment: str) -> None:
    truth, estimate = matched(name)
    aligned, scale = pose_errors.align(truth, estimate, alignment)
    metres, degrees = pose_errors.absolute_errors(truth, aligned)
    check(metres, GOLDEN[f"{name} ape {alignment} trans"])
    check(degrees, GOLDEN[f"{name} ape {alignment} rot"])
    expected = SCALE[name] if alignment == "sim3" else 1.0
    assert scale == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("name", list(FILES))
@pytest.mark.parametrize(
    ("unit", "delta"), [("frames", 1), ("frames", 10), ("meters", 1.0), ("meters", 0.1)]
)
@pytest.mark.parametrize("all_pairs", [True, False])
def test_rpe_is_evos(name: str, unit: str, delta: float, all_pairs: bool) -> None:
    truth, estimate = matched(name)
    aligned, _ = pose_errors.align(truth, estimate, "se3")
    if unit == "frames":
        pairs = pose_errors.pairs_by_frames(len(truth), int(delta), all_pairs=all_pairs)
    else:
        steps = np.linalg.norm(np.diff(aligned[:, 4:], axis=0), axis=1)
        pairs = pose_errors.pairs_by_length(steps, delta, all_pairs=all_pairs)
    metres, degrees = pose_errors.relative_errors(truth, aligned, pairs)
    key = f"{name} rpe {unit} {delta} {'all' if all_pairs else 'seq'}"
    check(metres, GOLDEN[f"{key} trans"])
    check(degrees, GOLDEN[f"{key} rot"])


def test_errors_of_a_moved_copy_vanish_after_alignment() -> None:
    rng = np.random.default_rng(4)
    truth = se3.make(so3.exp(rng.normal(size=(30, 3))), rng.normal(size=(30, 3)))
    turn = se3.make(so3.exp([0.0, 0.0, 2.0]), [3.0, -1.0, 0.5])
    moved = se3.compose(turn, truth)
    for alignment in ("se3", "sim3", "yaw"):
        aligned, scale = pose_errors.align(truth, moved, alignment)
        metres, degrees = pose_errors.absolute_errors(truth, aligned)
        assert np.max(metres) < 1e-13
        assert np.max(degrees) < 1e-11
        assert scale == pytest.approx(1.0)
    pairs = pose_errors.pairs_by_frames(30, 3, all_pairs=True)
    assert np.max(pose_errors.relative_errors(truth, moved, pairs)[0]) < 1e-13
    with pytest.raises(EstimationError, match="not one of se3, sim3, yaw, none"):
        pose_errors.align(truth, moved, "afine")


def brute_force_pairs(steps: np.ndarray, delta: float) -> list[list[int]]:
    travelled = np.concatenate([[0.0], np.cumsum(steps)])
    pairs = []
    for i in range(len(steps)):
        difference = np.abs(travelled[i + 1 :] - travelled[i] - delta)
        best = int(np.argmin(difference))
        if difference[best] <= 0.1 * delta:
            pairs.append([i, i + 1 + best])
    return pairs


@pytest.mark.parametrize("seed", range(20))
def test_all_pairs_are_those_of_an_exhaustive_search(seed: int) -> None:
    rng = np.random.default_rng(seed)
    steps = rng.exponential(0.3, 60) * (rng.random(60) > 0.3)
    pairs = pose_errors.pairs_by_length(steps, 1.0, all_pairs=True)
    assert pairs.tolist() == brute_force_pairs(steps, 1.0)


def test_consecutive_pieces_do_not_overlap() -> None:
    pairs = pose_errors.pairs_by_length(np.full(10, 0.25), 0.5, all_pairs=False)
    assert pairs.tolist() == [[0, 2], [2, 4], [4, 6], [6, 8], [8, 10]]
    assert pose_errors.pairs_by_length(np.full(3, 0.1), 5.0, all_pairs=False).shape == (0, 2)
    assert pose_errors.pairs_by_length(np.full(3, 0.1), 5.0, all_pairs=True).shape == (0, 2)
    assert pose_errors.pairs_by_length(np.zeros(0), 5.0, all_pairs=True).shape == (0, 2)
    assert pose_errors.pairs_by_frames(5, 2, all_pairs=False).tolist() == [[0, 2], [2, 4]]
    assert pose_errors.pairs_by_frames(4, 2, all_pairs=True).tolist() == [[0, 2], [1, 3]]


def test_pieces_without_length_are_refused() -> None:
    with pytest.raises(EstimationError, match="at least one frame"):
        pose_errors.pairs_by_frames(5, 0, all_pairs=True)
    with pytest.raises(EstimationError, match="must be positive"):
        pose_errors.pairs_by_length(np.ones(3), 0.0, all_pairs=True)


def test_mean_rotation_ignores_signs() -> None:
    rng = np.random.default_rng(0)
    centre = so3.exp([0.3, -2.0, 1.0])
    q = so3.multiply(centre, so3.exp(rng.normal(size=(200, 3)) * 0.01))
    q[::3] *= -1.0
    mean = pose_errors.mean_rotation(q)
    assert np.linalg.norm(so3.log(so3.multiply(so3.inverse(centre), mean))) < 0.003


OPTIONS = TrajectoryEvaluationOptions()
START_NS = 1403715273262142976
PERIOD_NS = 5_000_000


def make_truth(count: int = 4000) -> Trajectory:
    s = np.arange(count) * 0.005
    p = np.stack([2 * np.sin(s), 3 * np.cos(0.7 * s), 0.5 * np.sin(1.3 * s)], axis=1)
    q = so3.exp(np.stack([0.3 * np.sin(s), 0.2 * np.cos(s), 0.5 * s], axis=1))
    return Trajectory(START_NS + np.arange(count) * PERIOD_NS, se3.make(q, p), source="truth")


def walked_map(truth: Trajectory, rows: np.ndarray, missions: int = 2) -> VIMap:
    """Vertices at rows of the truth, cut into missions with base frames of their own."""
    rng = np.random.default_rng(2)
    mission = np.sort(np.arange(len(rows)) * missions // len(rows)).astype(np.int32)
    T_G_M = se3.make(so3.exp(rng.normal(size=(missions, 3))), rng.normal(size=(missions, 3)))
    T_M_I = se3.compose(se3.inverse(T_G_M[mission]), truth.T_R_B[rows])
    return VIMap(
        missions=Missions.filled(
            missions, id=ids.random_ids(missions, rng), baseframe=np.arange(missions)
        ),
        baseframes=BaseFrames.filled(missions, T_G_M=T_G_M),
        vertices=Vertices.filled(
            len(rows), mission=mission, T_M_I=T_M_I, timestamp_ns=truth.times_ns[rows]
        ),
    )


def moved(vi_map: VIMap, delta: np.ndarray) -> VIMap:
    vertices = vi_map.vertices
    T_G_I = vi_map.T_G_I.copy()
    T_G_I[:, 4:] += delta
    T_M_I = se3.compose(se3.inverse(vi_map.T_G_M[vertices.mission]), T_G_I)
    return vi_map.replace(vertices=vertices.replace(T_M_I=T_M_I))


def test_a_true_map_has_no_error() -> None:
    truth = make_truth()
    report = evaluate_trajectory(walked_map(truth, np.arange(0, 4000, 40)), truth, OPTIONS)
    assert (report.vertices, report.matched, report.without_ground_truth) == (100, 100, 0)
    assert report.ape_m.rmse < 1e-12
    assert report.ape_deg.rmse < 1e-10
    assert report.scale == pytest.approx(1.0)
    assert report.rpe_m is not None
    assert report.rpe_m.rmse < 1e-12
    assert len(report.missions) == 2
    assert report.failure == ""


def test_known_errors_come_out() -> None:
    truth = make_truth()
    vi_map = walked_map(truth, np.arange(0, 4000, 40))
    delta = np.random.default_rng(1).normal(size=(100, 3)) * 0.1
    options = dataclasses.replace(OPTIONS, alignment="none")
    report = evaluate_trajectory(moved(vi_map, delta), truth, options)
    assert report.ape_m.rmse == pytest.approx(np.sqrt(np.mean(np.sum(delta**2, axis=1))))
    assert report.ape_m.max == pytest.approx(np.max(np.linalg.norm(delta, axis=1)))
    aligned = evaluate_trajectory(moved(vi_map, delta), truth, OPTIONS)
    assert aligned.ape_m.rmse <= report.ape_m.rmse
    assert aligned.ape_sim3_m is not None
    assert aligned.ape_sim3_m.rmse <= aligned.ape_m.rmse


def test_missions_can_be_chosen_and_are_also_aligned_alone() -> None:
    truth = make_truth()
    vi_map = walked_map(truth, np.arange(0, 4000, 40))
    shift = np.where(vi_map.vertices.mission[:, None] == 1, [5.0, 0.0, 0.0], 0.0)
    broken = moved(vi_map, shift)
    both = evaluate_trajectory(broken, truth, OPTIONS)
    assert both.ape_m.rmse > 0.5
    assert [m.ape_rmse_m for m in both.missions] == pytest.approx([0.0, 0.0], abs=1e-12)
    assert both.rpe_m is not None
    assert both.rpe_m.max < 1e-12
    one = evaluate_trajectory(broken, truth, OPTIONS, missions=np.array([1]))
    assert one.matched == 50
    assert one.ape_m.rmse < 1e-12


def test_interpolation_beats_the_nearest_pose() -> None:
    truth = make_truth()
    coarse = Trajectory(truth.times_ns[::10], truth.T_R_B[::10])
    vi_map = walked_map(truth, np.arange(5, 3900, 43))
    linear = evaluate_trajectory(vi_map, coarse, OPTIONS)
    nearest = evaluate_trajectory(vi_map, coarse, dataclasses.replace(OPTIONS, interpolate=False))
    assert linear.ape_m.rmse < 1e-3
    assert nearest.ape_m.rmse > 10 * linear.ape_m.rmse


def test_vertices_outside_the_span_or_in_a_gap_are_left_out() -> None:
    truth = make_truth()
    rows = np.arange(0, 4000, 40)
    kept = (np.arange(4000) >= 1) & ~((np.arange(4000) > 1000) & (np.arange(4000) < 1200))
    cut = Trajectory(truth.times_ns[kept], truth.T_R_B[kept])
    report = evaluate_trajectory(walked_map(truth, rows), cut, OPTIONS)
    assert report.without_ground_truth == 1 + 4
    _, matched = match(cut, truth.times_ns[rows], OPTIONS)
    assert np.flatnonzero(~matched).tolist() == [0, 26, 27, 28, 29]


def test_a_tight_tolerance_still_interpolates_coarse_ground_truth() -> None:
    truth = make_truth()
    coarse = Trajectory(truth.times_ns[::10], truth.T_R_B[::10])
    options = dataclasses.replace(OPTIONS, max_time_difference_s=0.01)
    _, matched = match(coarse, truth.times_ns[[100, 101, 103, 110]] + 24, options)
    assert matched.tolist() == [True, True, False, True]


def test_a_turned_body_frame_spoils_relative_errors_only_unless_aligned() -> None:
    truth = make_truth()
    turn = se3.make(so3.exp([0.0, 0.1, 0.0]), np.zeros(3))
    turned = Trajectory(truth.times_ns, se3.compose(truth.T_R_B, turn))
    vi_map = walked_map(truth, np.arange(0, 4000, 40))
    report = evaluate_trajectory(vi_map, turned, OPTIONS)
    assert report.ape_m.rmse < 1e-12
    assert report.body_rotation_deg == pytest.approx(np.degrees(0.1))
    assert report.rpe_m is not None
    assert report.rpe_m.rmse > 0.05
    options = dataclasses.replace(OPTIONS, align_body_frame=True)
    aligned = evaluate_trajectory(vi_map, turned, options)
    assert aligned.rpe_m is not None
    assert aligned.rpe_m.rmse < 1e-12
    assert aligned.ape_deg.rmse < 1e-10


@pytest.mark.parametrize(("unit", "delta", "count"), [("frames", 5, 90), ("s", 1.0, 90)])
def test_pieces_stay_within_missions(unit: str, delta: float, count: int) -> None:
    truth = make_truth()
    vi_map = walked_map(truth, np.arange(0, 4000, 40))
    options = dataclasses.replace(OPTIONS, rpe_delta=delta, rpe_delta_unit=unit)
    report = evaluate_trajectory(vi_map, truth, options)
    assert report.rpe_m is not None
    assert report.rpe_m.count == count


def test_wrong_requests_are_explained() -> None:
    truth = make_truth(400)
    vi_map = walked_map(truth, np.arange(0, 400, 40))
    late = Trajectory(truth.times_ns + 10**12, truth.T_R_B)
    with pytest.raises(EstimationError, match=r"only 0 of 10 vertices have ground truth.* ns, gr"):
        evaluate_trajectory(vi_map, late, OPTIONS)
    empty = Trajectory(np.zeros(0, dtype=np.int64), np.zeros((0, 7)))
    with pytest.raises(EstimationError, match="only 0 of 10"):
        evaluate_trajectory(vi_map, empty, OPTIONS)
    with pytest.raises(EstimationError, match="whole number of frames"):
        evaluate_trajectory(
            vi_map, truth, dataclasses.replace(OPTIONS, rpe_delta=1.5, rpe_delta_unit="frames")
        )
    with pytest.raises(FlagError, match="--rpe_delta_unit=miles: must be one of frames, m, s"):
        dataclasses.replace(OPTIONS, rpe_delta_unit="miles")


def test_motion_on_a_line_has_no_alignment_but_errors_without_one() -> None:
    truth = make_truth(400)
    T = truth.T_R_B.copy()
    T[:, 4:] = np.arange(400)[:, None] * np.array([0.01, 0.0, 0.0])
    line = Trajectory(truth.times_ns, T)
    vi_map = walked_map(line, np.arange(0, 400, 40))
    with pytest.raises(EstimationError, match="on one line"):
        evaluate_trajectory(vi_map, line, OPTIONS)
    report = evaluate_trajectory(vi_map, line, dataclasses.replace(OPTIONS, alignment="none"))
    assert report.ape_m.rmse < 1e-12
    assert (report.ape_sim3_m, report.scale) == (None, None)
    yaw = evaluate_trajectory(vi_map, line, dataclasses.replace(OPTIONS, alignment="yaw"))
    assert yaw.ape_m.rmse < 1e-12


@pytest.mark.parametrize(
    ("relative", "matched", "rmse"),
    [("ground_truth/V1_01_easy.csv", 149, 0.1177), ("euroc_imu/V101.gt.csv", 151, 0.1153)],
)
def test_raw_euroc_submaps(relative: str, matched: int, rmse: float) -> None:
    native = pytest.importorskip("maplab_py.storage.native")
    folder = shared_data("maplab_maps/euroc_v1_01")
    maps = [native.load_map(path)[0] for path in sorted(folder.iterdir())]
    times = np.concatenate([one.vertices.timestamp_ns for one in maps])
    T_G_I = np.concatenate([one.T_G_I for one in maps])
    times, first = np.unique(times, return_index=True)
    vi_map = VIMap(
        missions=Missions.filled(1, baseframe=[0]),
        baseframes=BaseFrames.filled(1),
        vertices=Vertices.filled(
            len(times), mission=np.zeros(len(times)), T_M_I=T_G_I[first], timestamp_ns=times
        ),
    )
    report = evaluate_trajectory(vi_map, read_trajectory(shared_data(relative)), OPTIONS)
    assert (report.vertices, report.matched) == (152, matched)
    assert report.ape_m.rmse == pytest.approx(rmse, abs=1e-4)
    assert report.scale == pytest.approx(0.9965, abs=1e-3)


def test_a_map_equals_itself() -> None:
    report = map_comparison.compare_maps(make_map(), make_map())
    assert report.is_identical
    assert report.in_words == "the maps are identical to the last bit"
    assert all(row.only_in_first == row.only_in_second == 0 for row in report.rows)
    assert report.position_m.largest == report.keypoint_px.largest == 0.0
    assert (report.descriptors_differing, report.sensors_differing) == (0, ())


def test_every_difference_is_measured() -> None:
    first = make_map()
    T = first.vertices.T_M_I.copy()
    T[3] = se3.compose(T[3], se3.make(so3.exp([0.0, 0.0, np.deg2rad(2.0)]), [0.3, 0.0, 0.0]))
    uv = first.keypoints.uv_px.copy()
    uv[5] += [3.0, 4.0]
    landmark = first.keypoints.landmark.copy()
    landmark[0] = -1
    descriptor = first.keypoints.descriptor.copy()
    descriptor[7, 0] ^= 1
    quality = first.landmarks.quality.copy()
    quality[0] = LandmarkQuality.BAD
    second = first.replace(
        vertices=first.vertices.replace(T_M_I=T),
        keypoints=first.keypoints.replace(uv_px=uv, landmark=landmark, descriptor=descriptor),
        landmarks=first.landmarks.replace(quality=quality),
    )
    report = map_comparison.compare_maps(first, second)
    assert not report.is_identical
    assert "this map has 1 more observations; vertices moved by" in report.in_words
    assert "at most 300 mm and 2 deg" in report.in_words
    assert "1 landmarks are judged differently" in report.in_words
    assert report.position_m.largest == pytest.approx(0.3)
    assert report.rotation_deg.largest == pytest.approx(2.0)
    assert report.keypoint_px.largest == pytest.approx(5.0)
    observations = next(row for row in report.rows if row.what == "observations")
    assert (observations.only_in_first, observations.only_in_second) == (1, 0)
    assert (report.descriptors_differing, report.landmarks_of_other_quality) == (1, 1)


def test_maps_with_nothing_in_common() -> None:
    report = map_comparison.compare_maps(make_map(), VIMap())
    rows = {row.what: row for row in report.rows}
    assert (rows["vertices"].in_both, rows["vertices"].only_in_first) == (0, 12)
    assert report.position_m.compared == 0
