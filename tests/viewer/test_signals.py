"""What is plotted along a mission, and both images of a closure."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from maplab_py.geometry import se3
from maplab_py.interop.trajectories import Trajectory
from maplab_py.sensors import SensorSet
from maplab_py.viewer.display.selection import closure_picture, matches_of_frames
from maplab_py.viewer.drawing import make_drawing
from maplab_py.viewer.options import VisualizationOptions
from maplab_py.viewer.playback import observation_signals, vertex_signals
from maplab_py.viewer.resource_clouds import VertexImages
from maplab_py.vimap import VIMap
from maplab_py.vimap.descriptors import binary_blocks, no_blocks
from tests.vimap.builders import walk_map


def _titles(vi_map: VIMap, truth: Trajectory | None = None) -> dict[str, np.ndarray]:
    drawing = make_drawing(vi_map, VisualizationOptions())
    return {signal.title: signal.values for signal in vertex_signals(drawing, truth)}


def test_states_are_those_of_the_vertices() -> None:
    rng = np.random.default_rng(0)
    vi_map = walk_map()
    states = {name: rng.normal(size=(12, 3)) for name in ("v_M", "accel_bias", "gyro_bias")}
    signals = _titles(vi_map.replace(vertices=vi_map.vertices.replace(**states)))
    np.testing.assert_array_equal(signals["velocity"], states["v_M"])
    np.testing.assert_array_equal(signals["accelerometer bias"], states["accel_bias"])
    np.testing.assert_array_equal(signals["gyroscope bias"], states["gyro_bias"])
    without = {name: np.zeros((12, 3)) for name in states}
    signals = _titles(vi_map.replace(vertices=vi_map.vertices.replace(**without)))
    assert not {"velocity", "accelerometer bias", "gyroscope bias"} & set(signals)


def test_errors_and_counts_are_those_of_the_observations() -> None:
    vi_map = walk_map()
    uv_px = np.array(vi_map.keypoints.uv_px)
    observed = vi_map.keypoints.landmark >= 0
    uv_px[:, 0] += 3.0 * (vi_map.keypoint_vertex == 4)
    shifted = vi_map.replace(keypoints=vi_map.keypoints.replace(uv_px=uv_px))
    error_px, landmarks = observation_signals(shifted)
    np.testing.assert_allclose(error_px[4], 3.0, atol=1e-3)
    np.testing.assert_allclose(np.delete(error_px, 4), 0.0, atol=1e-3)
    expected = [
        len(np.unique(vi_map.keypoints.landmark[observed & (vi_map.keypoint_vertex == row)]))
        for row in range(12)
    ]
    np.testing.assert_array_equal(landmarks, expected)


def test_bad_landmarks_do_not_count_in_the_error() -> None:
    vi_map = walk_map()
    p_I, quality = np.array(vi_map.landmarks.p_I), np.array(vi_map.landmarks.quality)
    p_I[::5] += 0.4
    quality[::5] = 1
    table = vi_map.landmarks.replace(p_I=p_I, quality=quality)
    error_px, _ = observation_signals(vi_map.replace(landmarks=table))
    np.testing.assert_allclose(error_px, 0.0, atol=1e-3)


def test_without_calibrated_cameras_there_is_no_error() -> None:
    signals = _titles(walk_map().replace(sensors=SensorSet()))
    assert "reprojection error" not in signals
    assert "landmarks" in signals


def test_the_position_error_needs_truth() -> None:
    vi_map = walk_map()
    truth = Trajectory(
        vi_map.vertices.timestamp_ns[:-2], np.array(vi_map.T_G_I)[:-2], source="truth.csv"
    )
    assert "position error" not in _titles(vi_map)
    T = np.array(truth.T_R_B)
    T[3, 4:] += [0.0, 0.0, 0.5]
    error_m = _titles(vi_map, dataclasses.replace(truth, T_R_B=T))["position error"][:, 0]
    assert np.isnan(error_m[-2:]).all()
    assert int(np.nanargmax(error_m)) == 3
    assert error_m[3] == pytest.approx(0.5, abs=0.1)
    turned = se3.compose(se3.make([0.0, 0.0, 1.0, 0.0], [4.0, 5.0, 6.0]), truth.T_R_B)
    signals = _titles(vi_map, dataclasses.replace(truth, T_R_B=turned))
    assert "position error" in signals
    np.testing.assert_allclose(signals["position error"][:-2], 0.0, atol=1e-6)


def _vertex_pair(vi_map: VIMap) -> tuple[int, int]:
    """Return two frames (rows) of neighbouring vertices."""
    first = int(np.flatnonzero(vi_map.frames.vertex == 3)[0])
    return first, int(np.flatnonzero(vi_map.frames.vertex == 4)[0])


def test_landmarks_in_common_are_matches() -> None:
    vi_map = walk_map(landmarks=200)
    matches = matches_of_frames(vi_map, *_vertex_pair(vi_map))
    landmark = vi_map.keypoints.landmark
    assert matches.are_landmarks
    assert len(matches) > 5
    np.testing.assert_array_equal(landmark[matches.first], landmark[matches.second])
    assert (landmark[matches.first] >= 0).all()
    assert matches.note == f"{len(matches)} landmarks in common in these images"


def _without_common_landmarks(vi_map: VIMap, second: int) -> VIMap:
    """Return the map whose second frame observes nothing, with descriptors equal per landmark."""
    landmark = vi_map.keypoints.landmark.copy()
    rng = np.random.default_rng(0)
    words = rng.integers(0, 256, (len(vi_map.landmarks) + 1, 48), dtype=np.uint8)
    descriptor = words[landmark]
    landmark[slice(*vi_map.keypoint_start[second : second + 2])] = -1
    return vi_map.replace(
        frames=vi_map.frames.replace(
            descriptor_blocks=binary_blocks(vi_map.frames.keypoint_count, 48)
        ),
        keypoints=vi_map.keypoints.replace(landmark=landmark, descriptor=descriptor),
    )


def test_without_them_similar_descriptors_are() -> None:
    vi_map = walk_map(landmarks=200)
    first, second = _vertex_pair(vi_map)
    common = matches_of_frames(vi_map, first, second)
    matches = matches_of_frames(_without_common_landmarks(vi_map, second), first, second)
    assert not matches.are_landmarks
    before = vi_map.keypoints.landmark
    np.testing.assert_array_equal(before[matches.first], before[matches.second])
    assert set(matches.first.tolist()) >= set(common.first[before[common.first] >= 0].tolist())


def test_frames_without_descriptors_have_no_matches() -> None:
    vi_map = walk_map(landmarks=200)
    first, second = _vertex_pair(vi_map)
    landmark = np.full(len(vi_map.keypoints), -1, dtype=np.int32)
    frames = vi_map.frames.replace(descriptor_blocks=no_blocks(len(vi_map.frames)))
    bare = vi_map.replace(frames=frames, keypoints=vi_map.keypoints.replace(landmark=landmark))
    assert len(matches_of_frames(bare, first, second)) == 0


class _Images(VertexImages):
    """Grey images of all vertices but the first."""

    def __init__(self, vi_map: VIMap) -> None:
        super().__init__(vi_map, Path())
        self._vi_map = vi_map

    def image(self, vertex: int) -> np.ndarray | None:
        return None if vertex == 0 else np.full((480, 640, 3), 90, dtype=np.uint8)

    def frame(self, vertex: int) -> int:
        return int(np.flatnonzero(self._vi_map.frames.vertex == vertex)[0])


def test_lines_join_the_keypoints_in_both_images() -> None:
    vi_map = walk_map(landmarks=200)
    images = _Images(vi_map)
    shown = closure_picture(vi_map, images, 3, 4)
    assert shown is not None
    picture, note = shown
    matches = matches_of_frames(vi_map, *_vertex_pair(vi_map))
    assert note == matches.note
    assert picture.shape == (480, 2 * 640 + 6, 3)
    uv = vi_map.keypoints.uv_px
    middle = 0.5 * (uv[matches.first] + uv[matches.second] + [646, 0])
    for x, y in np.round(middle).astype(int):
        patch = picture[max(y - 2, 0) : y + 3, x - 2 : x + 3].reshape(-1, 3)
        assert (patch == (255, 153, 0)).all(axis=1).any()
    assert closure_picture(vi_map, images, 0, 4) is None
