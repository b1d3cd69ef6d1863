"""Features of rendered images: where they are, what they replace, and what they become."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from maplab_py.algorithms.image_features import extraction, tracks
from maplab_py.algorithms.image_features.extraction import extract_features
from maplab_py.algorithms.image_features.options import ExtractionOptions, FeatureTrackOptions
from maplab_py.algorithms.landmarks.options import LandmarkQualityOptions
from maplab_py.algorithms.landmarks.tracks import init_tracks
from maplab_py.errors import Cancelled, EstimationError, FlagError, MaplabError, UserError
from maplab_py.interop.resources.images import import_images
from maplab_py.progress import SilentProgress
from maplab_py.storage.native import load_map, save_map
from maplab_py.vimap import VIMap, consistency, table
from maplab_py.vision.features import extension, extractors
from maplab_py.vision.features.extension import ExtractedFeatures, feature_extractor
from tests.support.small_xfeat import xfeat_or_skip
from tests.support.stereo_room import StereoRoom, quarter_size

SIFT = ExtractionOptions(max_features=250)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> StereoRoom:
    scenario = quarter_size(frame_rate_hz=2.0)
    sessions = (dataclasses.replace(scenario.sessions[0], duration_s=5.0),)
    folder = tmp_path_factory.mktemp("features")
    return StereoRoom.simulated(folder, dataclasses.replace(scenario, sessions=sessions))


@pytest.fixture(scope="module")
def with_images(room: StereoRoom) -> VIMap:
    """The map with true poses and its images."""
    return import_images(room.true_map, 0, room.recording)[0]


@pytest.fixture(scope="module")
def sift(with_images: VIMap) -> VIMap:
    return extract_features(with_images, Path(), SIFT)[0]


def same_tables(a: VIMap, b: VIMap) -> bool:
    return (
        all(
            np.array_equal(getattr(a.keypoints, name), getattr(b.keypoints, name))
            for name in a.keypoints.columns()
        )
        and a.frames.descriptor_blocks.tolist() == b.frames.descriptor_blocks.tolist()
    )


def test_features_follow_the_keypoints_of_a_frame(with_images: VIMap, sift: VIMap) -> None:
    assert not consistency.check_consistency(sift).errors
    of_sift = sift.feature_type == 3
    assert np.count_nonzero(of_sift) == 250 * len(sift.frames)
    old, before = sift.keypoints.take(np.flatnonzero(~of_sift)), with_images.keypoints
    np.testing.assert_array_equal(old.uv_px, before.uv_px)
    np.testing.assert_array_equal(old.landmark, before.landmark)
    np.testing.assert_array_equal(old.descriptor[:, :48], before.descriptor[:, :48])
    for row, blocks in enumerate(sift.frames.descriptor_blocks):
        assert [block.feature_type for block in blocks] == [0, 3]
        assert blocks[0].keypoints == with_images.frames.keypoint_count[row]
    new = sift.keypoints.take(np.flatnonzero(of_sift))
    assert set(new.sigma_px.tolist()) == {0.8}
    assert (new.landmark == -1).all()
    assert (new.track_id == -1).all()
    assert (new.scale > 0.0).all()
    length = np.linalg.norm(new.descriptor[:, :128].astype(np.float64), axis=1)
    np.testing.assert_allclose(length, 512.0, rtol=0.02)


def test_a_map_with_features_is_saved_and_loaded(sift: VIMap, tmp_path: Path) -> None:
    save_map(sift, tmp_path / "map")
    again, _ = load_map(tmp_path / "map")
    assert same_tables(again, sift)


@pytest.mark.parametrize("name", sorted(extractors.KINDS))
def test_the_features_do_not_depend_on_threads(
    with_images: VIMap, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if name == "xfeat":
        xfeat_or_skip()
    options = ExtractionOptions(feature_type=name, max_features=60)
    several, report = extract_features(with_images, Path(), options)
    monkeypatch.setattr(extraction.os, "cpu_count", lambda: 1)
    single, _ = extract_features(with_images, Path(), options)
    assert same_tables(several, single)
    assert report.descriptor_bytes == extractors.KINDS[name].size
    assert 0 < report.keypoints <= 60 * report.images


def test_frames_that_have_such_features_stay_unless_replaced(sift: VIMap) -> None:
    again, report = extract_features(sift, Path(), SIFT)
    assert again.keypoints is sift.keypoints or same_tables(again, sift)
    assert (report.images, report.frames_that_had_some) == (0, len(sift.frames))
    tracked, _ = tracks.track_features(sift, FeatureTrackOptions())
    with_landmarks, _ = init_tracks(tracked, LandmarkQualityOptions())
    made = int(np.count_nonzero(with_landmarks.landmarks.feature_type == 3))
    assert made > 50
    options = dataclasses.replace(SIFT, max_features=100, replace=True)
    replaced, report = extract_features(with_landmarks, Path(), options)
    assert report.keypoints_removed == np.count_nonzero(sift.feature_type == 3)
    assert report.landmarks_removed == made
    assert np.count_nonzero(replaced.feature_type == 3) == 100 * len(sift.frames)
    assert not consistency.check_consistency(replaced).errors


def test_tracks_show_one_point_of_the_room(room: StereoRoom, sift: VIMap) -> None:
    tracked, report = tracks.track_features(sift, FeatureTrackOptions())
    assert report.frame_pairs == 2 * (2 * len(sift.vertices) - 3)
    assert report.tracks > 150
    assert report.mean_track_length > 2.5
    before = sift.keypoints.track_id
    kept = before >= 0
    np.testing.assert_array_equal(tracked.keypoints.track_id[kept], before[kept])
    new = np.flatnonzero(tracked.keypoints.track_id != before)
    assert set(tracked.feature_type[new].tolist()) == {3}
    pairs = np.stack([tracked.keypoint_frame[new], tracked.keypoints.track_id[new]])
    assert len(np.unique(pairs, axis=1).T) == len(new)
    result, _ = init_tracks(tracked, LandmarkQualityOptions())
    mine = (result.landmarks.feature_type == 3) & (result.landmarks.quality == 2)
    distance = room.distances_to_surfaces(result.p_G[mine])
    assert np.count_nonzero(mine) > 80
    assert np.median(distance) < 0.03
    assert np.mean(distance > 0.3) < 0.05
    with pytest.raises(EstimationError, match="no Binary descriptors of 32 bytes"):
        tracks.track_features(sift, FeatureTrackOptions(feature_type="orb"))


def test_frames_that_share_nothing_have_no_tracks(sift: VIMap) -> None:
    tracked, report = tracks.track_features(sift, FeatureTrackOptions(max_descriptor_distance=1e-6))
    assert (report.matches, report.tracks, report.mean_track_length) == (0, 0, 0.0)
    assert same_tables(tracked, sift)


def test_all_tracked_keypoints_are_left_alone(sift: VIMap) -> None:
    ids = np.arange(len(sift.keypoints), dtype=np.int32)
    numbered = sift.replace(keypoints=sift.keypoints.replace(track_id=ids))
    with pytest.raises(EstimationError, match="SIFT of 128 bytes have a track or a landmark"):
        tracks.track_features(numbered, FeatureTrackOptions())


def test_a_cancelled_extraction_ends_at_once(with_images: VIMap) -> None:
    class Impatient(SilentProgress):
        def step(self, done: float, total: float, what: str = "") -> None:
            raise Cancelled("enough")

    with pytest.raises(Cancelled):
        extract_features(with_images, Path(), SIFT, progress=Impatient())


def test_maps_without_images_and_bare_keypoints_are_refused(
    room: StereoRoom, with_images: VIMap
) -> None:
    with pytest.raises(UserError, match="no images to extract features from: attach"):
        extract_features(room.true_map, Path(), SIFT)
    frames = with_images.frames
    bare = with_images.replace(
        frames=frames.replace(descriptor_blocks=table.object_column([None] * len(frames)))
    )
    with pytest.raises(
        UserError, match="keypoints without descriptors, which the map format cannot"
    ):
        extract_features(bare, Path(), SIFT)
    replaced, report = extract_features(
        bare, Path(), dataclasses.replace(SIFT, max_features=20, replace=True)
    )
    assert report.keypoints_removed == len(with_images.keypoints)
    assert len(replaced.keypoints) == 20 * len(frames)
    assert len(replaced.landmarks) == 0


@pytest.mark.parametrize(
    ("flag", "value", "message"),
    [
        ("feature_type", "surf", "wants sift, orb, brisk, akaze, xfeat or plugin:NAME"),
        ("max_features", 0, "must be at least 1"),
        ("feature_sigma_px", 0.0, "above 0"),
        ("feature_model", "net.onnx", "sift takes no file"),
    ],
)
def test_wrong_values_are_refused(flag: str, value: object, message: str) -> None:
    with pytest.raises(FlagError, match=message):
        ExtractionOptions(**{flag: value})


def grid(image: np.ndarray) -> ExtractedFeatures:
    """Describe 40 places by the grey values around them."""
    v, u = np.meshgrid(np.arange(20, 220, 50), np.arange(20, 360, 34), indexing="ij")
    uv = np.stack([u.ravel(), v.ravel()], axis=1)
    patches = [image[y - 4 : y + 4, x - 4 : x + 4].reshape(-1) for x, y in uv.tolist()]
    return ExtractedFeatures(uv, np.arange(len(uv)), np.array(patches, dtype=np.float32))


@pytest.fixture
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(extension, "REGISTERED", dict(extension.REGISTERED))


def test_an_extractor_of_a_plugin(with_images: VIMap, registered: None) -> None:
    feature_extractor("grid", feature_type="R2D2")(lambda _: grid)
    options = ExtractionOptions(feature_type="plugin:grid", max_features=30)
    result, report = extract_features(with_images, Path(), options)
    assert (report.feature_type, report.descriptor_bytes) == ("R2D2", 256)
    assert np.count_nonzero(result.feature_type == 2) == 30 * len(result.frames)
    rows = np.flatnonzero(result.feature_type == 2)[:30]
    expected = grid(np.zeros((240, 376), dtype=np.uint8)).keypoints_px[::-1][:30]
    np.testing.assert_array_equal(result.keypoints.uv_px[rows], expected)
    again, report = extract_features(result, Path(), options)
    assert same_tables(again, result)
    assert report.frames_that_had_some == len(result.frames)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (None, "gave NoneType, not ExtractedFeatures"),
        (ExtractedFeatures(np.zeros((3, 3)), np.zeros(3), np.zeros((3, 4), np.uint8)), r"\(K, 2\)"),
        (ExtractedFeatures(np.zeros((3, 2)), np.zeros(2), np.zeros((3, 4), np.uint8)), r"\(K,\)"),
        (ExtractedFeatures(np.zeros((3, 2)), np.zeros(3), np.zeros((2, 4), np.uint8)), r"\(3, D\)"),
        (ExtractedFeatures(np.zeros((3, 2)), np.zeros(3), np.zeros((3, 4))), "float64, not uint8"),
        (
            ExtractedFeatures(np.full((3, 2), np.nan), np.zeros(3), np.zeros((3, 4), np.uint8)),
            "a keypoint is not a number",
        ),
    ],
)
def test_what_a_plugin_gives_is_checked(
    with_images: VIMap, registered: None, value: object, message: str
) -> None:
    feature_extractor("broken", feature_type="SuperPoint")(lambda _: lambda _: value)
    with pytest.raises(MaplabError, match=f"plugin:broken: .*{message}"):
        extract_features(with_images, Path(), ExtractionOptions(feature_type="plugin:broken"))


def test_plugins_and_files_that_are_not_there(with_images: VIMap, registered: None) -> None:
    options = ExtractionOptions(feature_type="plugin:nothing")
    with pytest.raises(UserError, match="no plugin has a feature extractor 'nothing'; there are"):
        extract_features(with_images, Path(), options)
    feature_extractor("grid", feature_type="R2D2")(lambda _: grid)
    options = ExtractionOptions(feature_type="plugin:grid", feature_model="nowhere.onnx")
    with pytest.raises(UserError, match=r"--feature_model=nowhere\.onnx: there is no such file"):
        extract_features(with_images, Path(), options)
    with pytest.raises(ValueError, match="letters, digits and underscores"):
        feature_extractor("a b", feature_type="SIFT")
    with pytest.raises(FlagError, match="Surf is no feature type"):
        feature_extractor("surf", feature_type="Surf")
