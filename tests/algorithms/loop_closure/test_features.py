"""Features that take part, of one type or of several."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from maplab_py.algorithms.landmarks.keypoint_rays import bearings
from maplab_py.algorithms.landmarks.quality import evaluate_unknown_quality
from maplab_py.algorithms.localization.database import database_of_map, database_of_summary
from maplab_py.algorithms.localization.localization import localize_missions
from maplab_py.algorithms.localization.options import LocalizationOptions
from maplab_py.algorithms.loop_closure.features import map_features
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.workflow import close_loops
from maplab_py.algorithms.summary.options import SummaryMapOptions
from maplab_py.algorithms.summary.summary import make_summary_map
from maplab_py.algorithms.vi_optimization.data_selection import select
from maplab_py.algorithms.vi_optimization.options import DataOptions
from maplab_py.errors import EstimationError, FlagError, UserError
from maplab_py.sensors import Camera, Distortion, Projection
from maplab_py.sensors.projection import back_project
from maplab_py.storage.summary_map import read_summary_map, write_summary_map
from maplab_py.vimap import VIMap
from maplab_py.vimap.descriptors import DescriptorBlock, FeatureType, binary_blocks
from maplab_py.vimap.table import object_column
from tests.algorithms.loop_closure.rooms import Walk, make_map
from tests.support.float_features import with_numbers

CAMERA = Camera(
    "3" * 32,
    Projection.PINHOLE,
    Distortion.RADTAN,
    np.array([460.0, 455.0, 367.0, 248.0]),
    np.array([-0.28, 0.07, 2e-4, 2e-5]),
    752,
    480,
)


def test_the_angle_of_a_pixel_is_that_of_its_neighbourhood():
    uv = np.random.default_rng(0).uniform([-3.0, -2.0], [752.0, 480.0], (2000, 2))
    ray, angle, ok = bearings(CAMERA, uv)
    exact, valid = back_project(CAMERA, uv)
    np.testing.assert_array_equal(ray, exact)
    right, below = (back_project(CAMERA, uv + step)[0] for step in ([1.0, 0.0], [0.0, 1.0]))
    area = np.linalg.norm(np.cross(right - exact, below - exact), axis=1)
    np.testing.assert_array_equal(ok, valid)
    np.testing.assert_allclose(angle[ok], np.sqrt(area[ok]), rtol=0.03)


def test_missions_with_descriptors_of_different_sizes_are_not_mixed():
    vi_map, _ = make_map([Walk(room=1), Walk(room=1, mission=1, vertices=8)])
    frames, mission = vi_map.frames, vi_map.vertices.mission[vi_map.frames.vertex]
    blocks = binary_blocks(frames.keypoint_count, np.where(mission == 1, 40, 48))
    mixed = vi_map.replace(frames=frames.replace(descriptor_blocks=blocks))
    with pytest.raises(EstimationError, match="has descriptors of 40 bytes, others have 48"):
        map_features(mixed, np.arange(2))
    for mission_row, bits in ((0, 384), (1, 320)):
        assert map_features(mixed, np.array([mission_row]))[0].kind.dimensions == bits


NUMBERS = LoopClosureOptions(feature_type="SuperPoint", max_descriptor_distance=0.9)
TWICE = [
    Walk(room=1, vertices=24),
    Walk(room=1, vertices=24, start_s=60.0, drift=(0.02, -0.01, 0.01, 0.002)),
]


def twice(flips: float = 0.06) -> VIMap:
    return make_map(TWICE, flips=flips)[0]


def test_numbers_close_the_loops_that_bits_close() -> None:
    vi_map = twice()
    _, by_bits = close_loops(vi_map)
    merged, by_numbers = close_loops(with_numbers(vi_map, scale=30.0), NUMBERS)
    assert by_bits.accepted > 10
    assert by_numbers.accepted >= by_bits.accepted
    assert by_numbers.landmarks_merged >= 0.9 * by_bits.landmarks_merged
    assert set(merged.landmarks.feature_type.tolist()) == {int(FeatureType.SUPERPOINT)}


def test_types_never_match_each_other() -> None:
    vi_map = twice()
    half = len(vi_map.frames) // 2
    other = with_numbers(vi_map)
    width = other.keypoints.descriptor.shape[1]
    descriptor = np.zeros((len(vi_map.keypoints), width), dtype=np.uint8)
    descriptor[:, :48] = vi_map.keypoints.descriptor
    cut = int(vi_map.keypoint_start[half])
    descriptor[cut:] = other.keypoints.descriptor[cut:]
    blocks = [
        first if row < half else second
        for row, (first, second) in enumerate(
            zip(vi_map.frames.descriptor_blocks, other.frames.descriptor_blocks, strict=True)
        )
    ]
    mixed = vi_map.replace(
        frames=vi_map.frames.replace(descriptor_blocks=object_column(blocks)),
        keypoints=vi_map.keypoints.replace(descriptor=descriptor),
    )
    for options in (LoopClosureOptions(), NUMBERS):
        features, _ = map_features(mixed, np.arange(1), feature_type=options.type_number)
        assert len(features) > 0
        assert len({bool(row < cut) for row in features.keypoint}) == 1
        _, report = close_loops(mixed, options)
        assert report.accepted == 0


def test_an_absent_type_is_refused_with_the_remedy() -> None:
    vi_map = twice()
    with pytest.raises(
        EstimationError, match="no SIFT descriptors, only Binary: --lc_feature_type=Binary"
    ):
        close_loops(vi_map, LoopClosureOptions(feature_type="SIFT"))
    with pytest.raises(EstimationError, match="no Binary descriptors of 32 bytes"):
        close_loops(vi_map, LoopClosureOptions(feature_descriptor_type="orb"))
    _, report = close_loops(vi_map, LoopClosureOptions(feature_descriptor_type="brisk"))
    assert report.accepted > 10
    with pytest.raises(
        FlagError, match=r"--lc_feature_type: Surf is no feature type: wants one of Bin"
    ):
        LoopClosureOptions(feature_type="Surf")
    assert LoopClosureOptions(feature_type="sift").type_number == 3
    assert LoopClosureOptions(feature_type="7").type_number == 7


def test_localisation_by_numbers_in_a_map_and_in_its_summary(tmp_path: Path) -> None:
    vi_map = with_numbers(make_map([Walk(room=1, vertices=24), Walk(room=1, mission=1)])[0])
    judged, _ = evaluate_unknown_quality(vi_map)
    options = LocalizationOptions(max_descriptor_distance=0.9)
    kind = FeatureType.SUPERPOINT
    full = database_of_map(judged, missions=np.array([0]), feature_type=kind)
    assert full.has_descriptors
    summary = make_summary_map(judged, SummaryMapOptions(), feature_type=kind)
    path = write_summary_map(summary, tmp_path)
    read = read_summary_map(path)
    assert read.descriptor_kind == (256, 1, 5)
    reduced = database_of_summary(read)
    assert reduced.projection.kind == full.projection.kind
    for database in (full, reduced):
        localized = localize_missions(database, judged, options, missions=np.array([1]))
        assert localized.is_localized.all()
        error = localized.T_G_I[:, 4:] - judged.T_G_I[localized.vertex, 4:]
        assert np.linalg.norm(error, axis=1).max() < 0.05


def test_queries_of_another_type_are_refused() -> None:
    vi_map, _ = evaluate_unknown_quality(twice())
    database = database_of_map(with_numbers(vi_map), feature_type=FeatureType.SUPERPOINT)
    with pytest.raises(EstimationError, match="no SuperPoint descriptors, only Binary"):
        localize_missions(database, vi_map, LocalizationOptions())


def test_an_optimisation_takes_landmarks_of_one_type() -> None:
    vi_map = twice()
    landmarks = vi_map.landmarks
    kind = np.where(np.arange(len(landmarks)) % 3 == 0, 3, 0).astype(np.int32)
    mixed = vi_map.replace(landmarks=landmarks.replace(feature_type=kind))
    every = select(mixed, DataOptions(), None)
    sift = select(mixed, DataOptions(feature_type="SIFT"), None)
    binary = select(mixed, DataOptions(feature_type="Binary"), None)
    assert set(kind[sift.landmarks]) == {3}
    assert len(sift.keypoints) + len(binary.keypoints) == len(every.keypoints)
    with pytest.raises(
        UserError, match="--ba_feature_type=R2D2: the map has no landmarks of that type"
    ):
        select(mixed, DataOptions(feature_type="R2D2"), None)
    with pytest.raises(FlagError, match="--ba_feature_type: brisk is no feature type"):
        DataOptions(feature_type="brisk")


def test_two_kinds_of_one_type_do_not_mix() -> None:
    vi_map = twice()
    blocks = [
        (DescriptorBlock(count, 32 if row % 3 == 0 else 48),)
        for row, count in enumerate(vi_map.frames.keypoint_count.tolist())
    ]
    mixed = vi_map.replace(frames=vi_map.frames.replace(descriptor_blocks=object_column(blocks)))
    long, _ = map_features(mixed, np.arange(1))
    short, _ = map_features(mixed, np.arange(1), sizes=(32,))
    assert (long.kind.size, short.kind.size) == (48, 32)
    assert not np.intersect1d(long.keypoint, short.keypoint).size
    assert dataclasses.astuple(long.descriptors)[1].dtype == np.uint64
