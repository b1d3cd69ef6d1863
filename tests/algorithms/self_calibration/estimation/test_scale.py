"""Parts that lose their lengths while solving are found, named and left out."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from maplab_py.algorithms.self_calibration import calibration as module
from maplab_py.algorithms.self_calibration.calibration import (
    calibrate,
    describe_partitions,
    partitions_without_scale,
)
from maplab_py.algorithms.self_calibration.estimation.problem import (
    SegmentProblem,
    build_segment_problem,
    parallax_rad,
)
from maplab_py.algorithms.self_calibration.segments.selection import collect
from maplab_py.algorithms.self_calibration.segments.splitting import extract_submap
from maplab_py.errors import EstimationError, UserError
from maplab_py.estimation.states import States
from maplab_py.vimap.edits import with_p_G
from tests.algorithms.self_calibration.scenes import EXACT, OPTIONS, scene_map, uncalibrated

APART = dataclasses.replace(EXACT, min_shared_landmarks=10**6)
ROWS = np.concatenate([np.arange(0, 30), np.arange(40, 61)])


def scaled(problem: SegmentProblem, partition: int, path: float, distance: float) -> States:
    """Make a partition's path and its landmarks' distances so many times what they are."""
    states = problem.states
    own = np.flatnonzero(problem.partition == partition)
    T_G_I, p_G = np.array(states.T_G_I), np.array(states.p_G)
    vi_map, selection = problem.vi_map, problem.selection
    vertex = vi_map.keypoint_vertex[selection.keypoints]
    landmark = np.searchsorted(selection.landmarks, vi_map.keypoints.landmark[selection.keypoints])
    seen = np.unique(landmark[np.isin(vertex, own)])
    middle = T_G_I[own[0], 4:]
    T_G_I[own, 4:] = middle + path * (T_G_I[own, 4:] - middle)
    p_G[seen] = middle + distance * (p_G[seen] - middle)
    return dataclasses.replace(states, T_G_I=T_G_I, p_G=p_G)


@pytest.mark.parametrize(
    ("path", "distance", "lost"),
    [
        (1.0, 1.0, []),
        (0.05, 0.05, [1]),
        (20.0, 20.0, [1]),
        # what drift added to a slow path goes, and the landmarks stay where they were
        (0.3, 1.0, []),
    ],
)
def test_a_partition_that_shrinks_as_a_whole_is_found(
    path: float, distance: float, lost: list[int]
) -> None:
    problem = build_segment_problem(extract_submap(scene_map(vertices=61), ROWS), APART)
    after = scaled(problem, 1, path, distance)
    assert partitions_without_scale(problem, after, problem).tolist() == lost


def test_what_is_left_out_is_named_and_does_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    start = extract_submap(uncalibrated(scene_map(vertices=61)), ROWS)

    def second_is_lost(problem: SegmentProblem, *_: object) -> np.ndarray:
        return np.arange(1, problem.num_partitions)

    monkeypatch.setattr(module, "partitions_without_scale", second_is_lost)
    result, report = calibrate(start, APART)
    # the scene begins at 0 s and has five vertices a second
    assert [one.split(", ")[1] for one in report.without_scale] == ["8.0 to 12.0 s"]
    assert report.partitions == 1
    alone, _ = calibrate(extract_submap(start, np.arange(30)), APART)
    np.testing.assert_allclose(result.change, alone.change, atol=1e-9)


def test_nothing_is_returned_when_too_little_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    start = extract_submap(uncalibrated(scene_map(vertices=61)), np.r_[np.arange(0, 4), 10:61])

    def second_is_lost(problem: SegmentProblem, *_: object) -> np.ndarray:
        return np.arange(1, problem.num_partitions)

    monkeypatch.setattr(module, "partitions_without_scale", second_is_lost)
    few = dataclasses.replace(OPTIONS, min_shared_landmarks=10**6)
    with pytest.raises(EstimationError, match=r"not excited.*without mission .*lengths are lost"):
        calibrate(start, few)


def test_names_of_runs() -> None:
    problem = build_segment_problem(extract_submap(scene_map(vertices=61), ROWS), APART)
    (name,) = describe_partitions(problem, np.array([0]))
    assert name.endswith("0.0 to 5.8 s")


def test_parallax_does_not_grow_where_landmarks_are_estimated_too_near() -> None:
    vi_map = scene_map(vertices=31)
    rows = np.arange(0, len(vi_map.landmarks), 4)
    home = vi_map.T_G_I[vi_map.landmarks.vertex[rows], 4:]
    near = with_p_G(vi_map, rows, home + 0.3 * (vi_map.p_G[rows] - home))
    before, after = parallax_rad(vi_map)[rows], parallax_rad(near)[rows]
    # by distance alone it would grow by 3.3
    assert np.median(after / before) <= 1.5


def test_groups_of_which_nothing_is_estimated_keep_no_segments() -> None:
    options = dataclasses.replace(OPTIONS, states="intrinsics,extrinsics_rotation")
    assert set(options.grouping()) == {"camera", "extrinsics"}
    database, _ = collect(scene_map(vertices=61, noise=1.0), options)
    assert set(database.tables) == {"camera", "extrinsics"}
    with pytest.raises(UserError, match="something is"):
        dataclasses.replace(options, groups="imu").grouping()
