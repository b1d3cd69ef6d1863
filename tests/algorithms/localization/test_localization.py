"""Localisation in simulated sessions against the truth; guided matching against brute force."""

import dataclasses
import functools
from functools import cache

import numpy as np
import pytest

from maplab_py.algorithms.landmarks.options import LandmarkQualityOptions
from maplab_py.algorithms.landmarks.quality import evaluate_quality
from maplab_py.algorithms.localization import guided, localization
from maplab_py.algorithms.localization.database import (
    LocalizationMap,
    database_of_map,
    database_of_summary,
)
from maplab_py.algorithms.localization.localizer import Localizer, Outcome
from maplab_py.algorithms.localization.options import LocalizationOptions
from maplab_py.algorithms.summary.options import SummaryMapOptions
from maplab_py.algorithms.summary.summary import make_summary_map
from maplab_py.array_types import F64, I64
from maplab_py.console.terminal.layout import Table, blocks_of
from maplab_py.errors import EstimationError, FlagError, UserError
from maplab_py.frontend.localization.keypoints import FrameKeypoints, frame_keypoints
from maplab_py.frontend.odometry import Odometry
from maplab_py.geometry import se3, so3
from maplab_py.interop.recordings.stream import EventStream
from maplab_py.simulation.scenario import MeasurementOptions, Scenario, SessionOptions, WorldOptions
from maplab_py.simulation.simulate import simulate
from maplab_py.vimap import IdIndex, VIMap
from maplab_py.vimap.descriptors import binary_blocks
from maplab_py.vision.descriptors import pack_words
from tests.frontend.known_start import updates_of
from tests.frontend.localization.places import place, summary
from tests.support.noiseless import without_noise

OPTIONS = LocalizationOptions()


@cache
def sessions() -> tuple[VIMap, VIMap, np.ndarray, np.ndarray]:
    """A map whose poses are true, a query, and the true poses of both."""
    scenario = Scenario(
        world=WorldOptions(landmarks_per_room=1500),
        measurement=MeasurementOptions(frame_rate_hz=5.0, max_keypoints=120),
        sessions=(
            SessionOptions(duration_s=14.0, turns=1.0),
            SessionOptions(duration_s=5.0, turns=0.3, start_turn=0.2, height_m=1.7),
        ),
    )
    scenario = dataclasses.replace(scenario, drift=without_noise(scenario).drift)
    data = simulate(scenario)
    truth = [data.truth.T_G_I[IdIndex(data.truth.vertex_id).rows(m.vertices.id)] for m in data.maps]
    # the stored base frame means nothing: put the mission where it was
    first = data.maps[0]
    T_G_M = data.truth.T_G_M[:1]
    first = first.replace(baseframes=first.baseframes.replace(T_G_M=T_G_M))
    quality = LandmarkQualityOptions(min_observers=3, min_observation_angle_deg=2.0)
    return evaluate_quality(first, quality)[0], data.maps[1], truth[0], truth[1]


@cache
def database(kind: str):
    vi_map = sessions()[0]
    if kind == "full":
        return database_of_map(vi_map)
    return database_of_summary(make_summary_map(vi_map, SummaryMapOptions()))


@pytest.mark.parametrize("kind", ["full", "summary"])
def test_queries_are_found_where_they_were(kind):
    _, query, _, truth = sessions()
    found = localization.localize_missions(database(kind), query, OPTIONS)
    reference = localization.Reference("truth", truth, np.ones(len(truth), dtype=bool))
    position, orientation = localization.pose_errors(found, reference, se3.identity())
    assert found.is_localized.mean() >= 0.9
    assert np.nanmax(position) < 0.2
    assert np.nanmedian(position) < 0.03
    assert np.nanmedian(orientation) < 0.5
    report = localization.describe(database(kind), found, reference=reference, T_R_G=se3.identity())
    assert report.map_kind == kind
    assert report.success == report.localized
    assert report.wrong == 0
    assert report.failure == ""


def test_errors_are_as_large_as_the_covariance_says():
    _, query, _, truth = sessions()
    found = localization.localize_missions(database("full"), query, OPTIONS)
    rows = np.flatnonzero(found.is_localized)
    step = se3.local(found.T_G_I[rows], truth[rows])
    covariance = np.array([found.answers[row].covariance for row in rows])
    nees = np.einsum("ni,ni->n", step, np.linalg.solve(covariance, step[..., None])[..., 0]) / 6.0
    # landmarks err too, which the covariance of the pose does not know
    assert 0.1 < np.median(nees) < 30.0


def test_a_sequence_is_localised_as_one_rig():
    _, query, _, truth = sessions()
    alone = localization.localize_missions(database("summary"), query, OPTIONS)
    together = localization.localize_missions(
        database("summary"), query, OPTIONS, sequence_length=4
    )
    assert together.is_localized.sum() >= alone.is_localized.sum()
    inliers = [np.median([a.inliers for a in f.answers]) for f in (alone, together)]
    assert inliers[1] > inliers[0]
    rows = np.flatnonzero(together.is_localized)
    error = np.linalg.norm(together.T_G_I[rows, 4:] - truth[rows, 4:], axis=1)
    assert np.median(error) < 0.03


def test_inliers_show_the_landmarks_they_are_matched_with():
    _, query, _, _ = sessions()
    source = localization.query_vertices(query, np.array([0]), database("full").projection)
    one = next(iter(localization.queries(source)))
    answer = Localizer(database("full"), OPTIONS).localize(one)
    assert answer.outcome is Outcome.LOCALIZED
    point_I = se3.transform(se3.inverse(answer.T_G_I), database("full").p_G[answer.landmark])
    toward = point_I - one.origin_I[answer.keypoint]
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    angle_px = np.linalg.norm(np.cross(toward, one.ray_I[answer.keypoint]), axis=1)
    assert np.all(angle_px <= 2.0 * one.rad_per_px[answer.keypoint] * 1.01)
    assert len(set(answer.keypoint.tolist())) == len(answer.keypoint)


def test_the_answer_does_not_depend_on_the_other_queries():
    _, query, _, _ = sessions()
    found = localization.localize_missions(database("full"), query, OPTIONS)
    source = localization.query_vertices(query, np.array([0]), database("full").projection)
    last = list(localization.queries(source))[-1]
    answer = Localizer(database("full"), OPTIONS).localize(last)
    np.testing.assert_array_equal(answer.T_G_I, found.T_G_I[-1])


def test_an_image_of_another_place_is_refused():
    rng = np.random.default_rng(5)
    _, query, _, _ = sessions()
    noise = rng.integers(0, 256, query.keypoints.descriptor.shape)
    strange = query.replace(keypoints=query.keypoints.replace(descriptor=noise))
    for kind in ("full", "summary"):
        found = localization.localize_missions(database(kind), strange, OPTIONS)
        assert not found.is_localized.any()
        report = localization.describe(database(kind), found)
        assert "none of" in report.failure
        assert sum(report.refused.values()) == len(found.vertex)


@pytest.mark.parametrize("kind", ["full", "summary"])
def test_true_looks_in_wrong_places_are_refused(kind):
    """Exchanged between keypoints, the descriptors match the map but nothing agrees with a pose."""
    rng = np.random.default_rng(3)
    _, query, _, _ = sessions()
    localizer = Localizer(database(kind), OPTIONS)
    source = localization.query_vertices(query, np.array([0]), database(kind).projection)
    for one in localization.queries(source):
        exchanged = one.descriptors[rng.permutation(len(one.descriptors))]
        answer = localizer.localize(dataclasses.replace(one, descriptors=exchanged))
        assert answer.outcome is not Outcome.LOCALIZED
        assert answer.inliers < OPTIONS.min_inlier_count - 1


def near(kind, one, T_G_I):
    d = database(kind)
    return guided.guided_matches(
        d,
        T_G_I,
        projected=d.projection.project(one.descriptors),
        words=pack_words(one.descriptors),
        origin_I=one.origin_I,
        ray_I=one.ray_I,
        radius_rad=12.0 * one.rad_per_px,
        max_distance=0.34 * 384 if kind == "full" else 52.0,
    )


def test_a_landmark_is_looked_for_from_where_it_was_seen():
    d = database("summary")
    s = d.sights
    assert np.all(s.nearest_m <= s.farthest_m)
    np.testing.assert_allclose(np.linalg.norm(s.direction, axis=1), 1.0)
    for label in (0, 17, len(d.p_G) - 1):
        observers = d.p_G_observer[d.observer[d.descriptors.label == label]]
        offset = observers - d.p_G[label]
        distance = np.linalg.norm(offset, axis=1)
        assert s.nearest_m[label] == pytest.approx(distance.min())
        assert s.farthest_m[label] == pytest.approx(distance.max())
        angle = np.arccos(np.clip(offset @ s.direction[label] / distance, -1.0, 1.0))
        assert s.spread_rad[label] == pytest.approx(angle.max(), abs=1e-6)


def test_gravity_must_agree():
    _, query, _, _ = sessions()
    source = localization.query_vertices(query, np.array([0]), database("full").projection)
    one = next(iter(localization.queries(source)))
    tilted = dataclasses.replace(one, q_M_I=so3.multiply(so3.exp([0.3, 0.0, 0.0]), one.q_M_I))
    answer = Localizer(database("full"), OPTIONS).localize(tilted)
    assert answer.outcome is not Outcome.LOCALIZED


def test_references_align_the_frames():
    vi_map, query, map_truth, truth = sessions()
    found = localization.localize_missions(database("full"), query, OPTIONS)
    T_R_G = se3.make(so3.exp([0.1, -0.2, 2.0]), [3.0, -1.0, 0.5])
    times = np.concatenate([vi_map.vertices.timestamp_ns, query.vertices.timestamp_ns])
    poses = se3.compose(T_R_G, np.concatenate([map_truth, truth]))
    reference, T = localization.ground_truth("recorded", times, poses, query, found, vi_map)
    assert T is not None
    np.testing.assert_allclose(T[4:], T_R_G[4:], atol=1e-3)
    _, from_answers = localization.ground_truth("recorded", times, poses, query, found, None)
    assert from_answers is not None
    assert np.nanmedian(localization.pose_errors(found, reference, from_answers)[0]) < 0.03
    with pytest.raises(UserError, match="time span"):
        localization.ground_truth("recorded", times + 10**15, poses, query, found, vi_map)


def test_an_unknown_base_frame_is_laid_on_the_answers():
    _, query, _, _ = sessions()
    found = localization.localize_missions(database("full"), query, OPTIONS)
    reference, T_R_G = localization.trajectory_of_queries(query, found)
    assert not query.baseframes.is_known.any()
    assert T_R_G is not None
    assert np.nanmedian(localization.pose_errors(found, reference, T_R_G)[0]) < 0.05
    known = query.replace(baseframes=query.baseframes.replace(is_known=[True]))
    _, T_R_G = localization.trajectory_of_queries(known, found)
    np.testing.assert_array_equal(T_R_G, se3.identity())


def test_a_robust_alignment_ignores_wrong_pairs():
    rng = np.random.default_rng(2)
    p_G = rng.uniform(-10.0, 10.0, (60, 3))
    T_R_G = se3.make(so3.exp([0.0, 0.0, 1.1]), [4.0, 5.0, 6.0])
    p_R = se3.transform(T_R_G, p_G)
    p_R[:15] += rng.uniform(3.0, 9.0, (15, 3))
    for level in (True, False):
        np.testing.assert_allclose(
            localization.align_robustly(p_R, p_G, level=level), T_R_G, atol=1e-6
        )


@pytest.mark.parametrize("size_m", [0.1, 20.0])
def test_poses_align_level_frames_where_they_lie_close_together_too(size_m: float):
    rng = np.random.default_rng(5)
    T_G_I = se3.make(so3.exp(rng.normal(size=(20, 3))), size_m * rng.uniform(-1.0, 1.0, (20, 3)))
    T_R_G = se3.make(so3.exp([0.0, 0.0, 3.1]), [4.0, 5.0, 6.0])
    noise = se3.make(
        so3.exp(rng.normal(scale=0.003, size=(20, 3))), rng.normal(scale=0.02, size=(20, 3))
    )
    T_R_I = se3.compose(se3.compose(T_R_G, T_G_I), noise)
    T_R_I[:6, 4:] += rng.uniform(1.0, 9.0, (6, 3))
    T_R_I[:6, :4] = so3.exp(rng.normal(size=(6, 3)))
    error = se3.local(T_R_G, localization.align_level(T_R_I, T_G_I))
    assert np.linalg.norm(error[:3]) < 0.03
    assert np.linalg.norm(error[3:]) < 0.004


def test_nonsense_is_refused():
    with pytest.raises(FlagError, match="min_inlier_count"):
        LocalizationOptions(min_inlier_count=2)
    vi_map, query, _, _ = sessions()
    summary = make_summary_map(vi_map, SummaryMapOptions())
    with pytest.raises(UserError, match="projection"):
        database_of_summary(dataclasses.replace(summary, projection=None))
    short = query.keypoints.replace(descriptor=query.keypoints.descriptor[:, :32])
    sizes = query.frames.replace(descriptor_blocks=binary_blocks(query.frames.keypoint_count, 32))
    with pytest.raises(EstimationError, match="32"):
        localization.localize_missions(
            database("full"), query.replace(keypoints=short, frames=sizes), OPTIONS
        )


def test_errors_are_empty_in_the_table_where_the_frames_are_not_aligned():
    query = sessions()[1]
    answers = localization.localize_missions(database("full"), query, OPTIONS)
    reference, T_R_G = localization.trajectory_of_queries(query, answers)
    assert T_R_G is not None
    report = localization.describe(database("full"), answers, reference=reference, T_R_G=T_R_G)
    [heads] = [block.heads for block in blocks_of(report) if isinstance(block, Table)]
    assert heads[1:3] == ["difference [m]", "difference [deg]"]
    facts = str(blocks_of(report))
    assert "near the path" in facts
    assert "wrong" not in facts
    assert "success" not in facts
    of_truth = dataclasses.replace(report, reference="truth")
    [heads] = [block.heads for block in blocks_of(of_truth) if isinstance(block, Table)]
    assert heads[1:3] == ["position error [m]", "orientation error [deg]"]
    header, *lines = localization.csv_lines(query, answers, reference, T_R_G)
    columns = header.strip().split(",")
    error = columns.index("position_error_m")
    assert len(lines) == len(answers.vertex)
    has_error = [line.split(",")[error] != "" for line in lines]
    assert has_error == (answers.is_localized & reference.is_known).tolist()
    for line in localization.csv_lines(query, answers, reference, None)[1:]:
        assert len(line.split(",")) == len(columns)
        assert line.split(",")[error] == ""


RADIUS_PX = 15.0


@functools.cache
def frames() -> list[tuple[FrameKeypoints, F64]]:
    """Return the keypoints of frames and their true poses (7,), with a second camera made up."""
    recording = place().recording()
    odometry = Odometry(recording.device, make_starter=place().start)
    result = []
    for update in updates_of(odometry, EventStream(recording)):
        seen = frame_keypoints(update, recording.device)
        row = int(np.searchsorted(place().times_ns, update.time_ns))
        result.append((seen, place().T_G_I[row]))
    return [pair for pair in result if len(pair[0]) > 30][::5]


def brute_force(
    database: LocalizationMap, T_G_I: F64, distance: F64, origin_I: F64, ray_I: F64, radius: F64
) -> set[tuple[int, int]]:
    """Return the pairs within the radius whose landmark may be visible; distance (N, O) of descriptors."""
    s, pairs = database.sights, set()
    back = T_G_I[4:] - database.p_G
    range_m = np.linalg.norm(back, axis=1)
    visible = (range_m < 2.0 * s.farthest_m) & (2.0 * range_m > s.nearest_m)
    visible &= np.einsum("li,li->l", s.direction, back) > s.least_cosine * range_m
    p_I = se3.transform(se3.inverse(T_G_I), database.p_G)
    for n in range(len(ray_I)):
        toward = p_I - origin_I[n]
        cosine = toward @ ray_I[n] / np.linalg.norm(toward, axis=1)
        for landmark in np.flatnonzero(visible & (cosine > np.cos(radius[n]))).tolist():
            if distance[n, database.descriptors.label == landmark].min() <= LIMIT:
                pairs.add((n, landmark))
    return pairs


LIMIT = 90.0
"""Bits of descriptors; projected ones are compared with another number."""


@pytest.mark.parametrize("kind", ["map", "summary"])
@pytest.mark.parametrize("cameras", [1, 2])
def test_it_returns_all_similar_pairs_near_the_pose(kind: str, cameras: int) -> None:
    database = database_of_map(place().vi_map) if kind == "map" else database_of_summary(summary())
    localizer = Localizer(database, LocalizationOptions())
    count = 0
    for seen, T_G_I in frames():
        described = localizer.described(seen.descriptors)
        origin_I, radius = seen.origin_I.copy(), RADIUS_PX * seen.rad_per_px
        if cameras == 2:
            origin_I[::2] += [0.1, 0.0, 0.02]
        if database.has_descriptors:
            a, b = (
                np.unpackbits(np.ascontiguousarray(w).view(np.uint8), axis=1).astype(np.float64)
                for w in (described.words, database.descriptors.words)
            )
            distance = a @ (1.0 - b.T) + (1.0 - a) @ b.T
        else:
            step = described.projected[:, None] - database.descriptors.projected[None]
            distance = np.sum(step * step, axis=2)
        # the same limit for both kinds
        scale = LIMIT / (LIMIT if database.has_descriptors else float(np.median(distance)))
        keypoint, landmark = guided.guided_matches(
            database, T_G_I, projected=described.projected, words=described.words,
            origin_I=origin_I, ray_I=seen.ray_I, radius_rad=radius, max_distance=LIMIT / scale,
        )  # fmt: skip
        pairs = list(zip(keypoint.tolist(), landmark.tolist(), strict=True))
        expected = brute_force(database, T_G_I, distance * scale, origin_I, seen.ray_I, radius)
        assert pairs == sorted(expected)
        count += len(pairs)
    assert count > 100


def test_pairs_are_all_returned_however_many_they_are() -> None:
    ray, toward = np.tile([[0.0, 0.0, 1.0]], (3, 1)), np.tile([[0.0, 0.0, 1.0]], (200, 1))
    first: I64 = np.zeros(3, dtype=np.int64)
    key, point = guided.near_pairs(ray, np.full(3, 0.9), first, first + 200, toward)
    np.testing.assert_array_equal(key, np.repeat(np.arange(3), 200))
    np.testing.assert_array_equal(point, np.tile(np.arange(200), 3))


def test_nothing_is_compiled_after_the_warmup() -> None:
    guided.compile_kernels()
    kernels = (guided.landmarks_in_view, guided.points_near, guided.least_distances)
    before = [list(kernel.signatures) for kernel in kernels]
    assert all(before)
    localizer = Localizer(database_of_summary(summary()), LocalizationOptions())
    seen, T_G_I = frames()[0]
    described = localizer.described(seen.descriptors)
    guided.guided_matches(
        database_of_summary(summary()), T_G_I, projected=described.projected,
        words=described.words, origin_I=seen.origin_I, ray_I=seen.ray_I,
        radius_rad=RADIUS_PX * seen.rad_per_px, max_distance=1.0,
    )  # fmt: skip
    assert [list(kernel.signatures) for kernel in kernels] == before
