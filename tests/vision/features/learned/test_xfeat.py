"""The graph of XFeat against a plain computation with the same weights, and its features."""

from concurrent.futures import Future
from typing import Any

import numpy as np
import pytest

from maplab_py.array_types import F64
from maplab_py.errors import UserError
from maplab_py.estimation.window.frame import Motion
from maplab_py.frontend.odometry_update import OdometryUpdate
from maplab_py.frontend.vertex_keypoints import VertexKeypoints, described_frames
from maplab_py.vimap.descriptors import DescriptorDepth, FeatureType
from maplab_py.vision.features.learned.checkpoint import Arrays
from maplab_py.vision.features.learned.installation import check_image
from maplab_py.vision.features.learned.xfeat import XFeat
from maplab_py.vision.features.learned.xfeat_graph import xfeat_graph
from maplab_py.vision.tracking.tracks import CameraTracks, TrackedImages
from tests.support.small_xfeat import random_arrays, xfeat_or_skip

pytest.importorskip("onnx", reason="the extra [learned] is not installed")
pytest.importorskip("onnxruntime", reason="the extra [learned] is not installed")


@pytest.fixture(scope="module")
def network() -> XFeat:
    return XFeat(xfeat_graph(random_arrays(), "random"), "random")


def convolve(x: F64, weight: F64, stride: int = 1) -> F64:
    """Return the correlation (O, H, W) of an image (C, H, W) with filters (O, C, k, k)."""
    size = weight.shape[2]
    padded = np.pad(x, ((0, 0), (size // 2,) * 2, (size // 2,) * 2))
    windows = np.lib.stride_tricks.sliding_window_view(padded, (size, size), axis=(1, 2))
    return np.einsum("chwij,ocij->ohw", windows[:, ::stride, ::stride], weight, optimize=True)


class Plain:
    """The network in a few lines, batch normalisation as it is defined."""

    def __init__(self, arrays: Arrays) -> None:
        self.arrays = {key: value.astype(np.float64) for key, value in arrays.items()}

    def layers(self, x: F64, block: str, strides: tuple[int, ...]) -> F64:
        for row, stride in enumerate(strides):
            a, name = self.arrays, f"{block}.{row}.layer"
            x = convolve(x, a[f"{name}.0.weight"], stride)
            mean, variance = a[f"{name}.1.running_mean"], a[f"{name}.1.running_var"]
            x = (x - mean[:, None, None]) / np.sqrt(variance + 1e-5)[:, None, None]
            x = np.maximum(x, 0.0)
        return x

    def last(self, x: F64, name: str) -> F64:
        return (
            convolve(x, self.arrays[f"{name}.weight"]) + self.arrays[f"{name}.bias"][:, None, None]
        )

    def descriptor_map(self, image: Any) -> F64:
        x = image[None].astype(np.float64)
        x = (x - x.mean()) / np.sqrt(x.var() + 1e-5)
        _, height, width = x.shape
        quarter = x.reshape(1, height // 4, 4, width // 4, 4).mean(axis=(2, 4))
        features = self.layers(x, "block1", (1, 2, 1, 2)) + self.last(quarter, "skip1.1")
        eighth = self.layers(self.layers(features, "block2", (1, 1)), "block3", (2, 1, 1))
        sixteenth = self.layers(eighth, "block4", (2, 1, 1))
        coarsest = self.layers(sixteenth, "block5", (2, 1, 1, 1))
        x = eighth + enlarged(sixteenth, 2) + enlarged(coarsest, 4)
        x = self.last(self.layers(x, "block_fusion", (1, 1)), "block_fusion.2")
        return np.asarray((x / np.linalg.norm(x, axis=0)).transpose(1, 2, 0))


def enlarged(x: F64, factor: int) -> F64:
    """Return an image (C, H, W) enlarged bilinearly; pixel centres keep their places."""
    for axis in (1, 2):
        count = x.shape[axis]
        where = np.clip((np.arange(count * factor) + 0.5) / factor - 0.5, 0, count - 1)
        low = np.minimum(where.astype(int), max(count - 2, 0))
        share = (where - low).reshape((-1, 1) if axis == 1 else (1, -1))
        x = x.take(low, axis) * (1 - share) + x.take(np.minimum(low + 1, count - 1), axis) * share
    return x


def test_the_graph_computes_the_network(network: XFeat) -> None:
    image = check_image()
    got, wanted = network.descriptor_map(image), Plain(random_arrays()).descriptor_map(image)
    assert got.shape == wanted.shape == (8, 12, 64)
    assert np.abs(got - wanted).max() < 1e-4 * np.abs(wanted).max()


def test_features_lie_in_images_of_any_size(network: XFeat) -> None:
    rng = np.random.default_rng(1)
    image = rng.integers(0, 256, (97, 131), dtype=np.uint8)
    features = network.extract(image, 40)
    again = network.extract(image, 40)
    assert 0 < len(features.scores) <= 40
    assert (np.diff(features.scores) <= 0.0).all()
    assert (features.keypoints_px > -0.5).all()
    assert (features.keypoints_px < [130.5, 96.5]).all()
    assert np.allclose(np.linalg.norm(features.descriptors, axis=1), 1.0, atol=1e-6)
    assert np.array_equal(features.descriptors, again.descriptors)
    described = network.describe(image, features.keypoints_px)
    assert np.allclose(described, features.descriptors, atol=1e-5)
    assert network.describe(image, np.zeros((0, 2))).shape == (0, 64)
    assert network.extract(np.full((97, 131), 90, dtype=np.uint8), 40).descriptors.shape == (0, 64)


def test_missing_arrays_and_damaged_networks_are_refused() -> None:
    arrays = random_arrays()
    arrays["skip1.1.bias"] = arrays["skip1.1.bias"][:5]
    with pytest.raises(
        UserError, match=r"mine: is no checkpoint of XFeat: skip1.1.bias is float32 \(5,\)"
    ):
        xfeat_graph(arrays, "mine")
    with pytest.raises(UserError, match="is no network: run install_features again"):
        XFeat(b"nothing", "x.onnx")


def test_installed_weights_match_a_moved_image() -> None:
    network = xfeat_or_skip()
    rng = np.random.default_rng(3)
    rough = np.kron(rng.integers(30, 220, (24, 32)), np.ones((10, 10))).astype(np.uint8)
    first, second = rough[:192, :256], rough[16:208, 8:264]
    a, b = network.extract(first, 200), network.extract((second * 0.4).astype(np.uint8), 200)
    similar = np.asarray(a.descriptors) @ np.asarray(b.descriptors).T
    best = np.argmax(similar, axis=1)
    mutual = np.argmax(similar, axis=0)[best] == np.arange(len(best))
    moved = a.keypoints_px[mutual] - b.keypoints_px[best[mutual]]
    is_right = np.linalg.norm(moved - [8.0, 16.0], axis=1) < 1.5
    assert np.count_nonzero(is_right) > 50
    assert np.mean(is_right) > 0.6


def test_tracked_keypoints_get_descriptors_of_numbers(
    network: XFeat, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("maplab_py.vision.features.learned.xfeat.installed_xfeat", lambda: network)
    image = np.random.default_rng(2).integers(0, 256, (96, 128), dtype=np.uint8)
    uv_px = np.array([[20.0, 30.5], [100.25, 60.0], [1.0, 94.0]])
    ids = np.arange(3)
    tracks = CameraTracks(uv_px, ids, np.ones(3), np.full(3, 12.0), ids)
    tracked = TrackedImages(0, (tracks,), 0.0, False, {}, "xfeat")
    (frame,) = described_frames(tracked, (image,), 5)
    assert (frame.feature_type, frame.depth) == (FeatureType.XFEAT, DescriptorDepth.FLOAT32)
    assert (frame.descriptor_size == 256).all()
    assert np.array_equal(frame.descriptor.view("<f4"), network.describe(image, uv_px))


def test_a_thread_describes_every_third_vertex(
    network: XFeat, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("maplab_py.vision.features.learned.xfeat.installed_xfeat", lambda: network)
    image = np.random.default_rng(2).integers(0, 256, (96, 128), dtype=np.uint8)
    ids = np.arange(2)
    uv_px = np.array([[60.0, 40.5], [70.25, 50.0]])
    tracks = CameraTracks(uv_px, ids, np.ones(2), np.full(2, 12.0), ids)
    tracked = TrackedImages(0, (tracks,), 0.0, False, {}, "brisk")
    update = OdometryUpdate(5, 0, tracked, Motion.MOVING, None, {}, images=(image,))
    keypoints = VertexKeypoints("xfeat", 3)
    frames = [keypoints.of(update) for _ in range(60)]
    assert all(isinstance(each, Future) for each in frames)
    described = [each.result()[0] for each in frames if isinstance(each, Future)]
    expected = [FeatureType.XFEAT, FeatureType.BINARY, FeatureType.BINARY] * 20
    assert [frame.feature_type for frame in described] == expected
    learned, binary = described[-3:-1]
    assert np.array_equal(learned.descriptor.view("<f4"), network.describe(image, uv_px))
    assert np.array_equal(learned.track_id, binary.track_id)
