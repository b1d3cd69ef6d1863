"""The graph of LighterGlue against a plain computation with the same weights, and its matches."""

from typing import Any

import numpy as np
import pytest

from maplab_py.array_types import F64
from maplab_py.errors import UserError
from maplab_py.vision.features.learned.checkpoint import Arrays
from maplab_py.vision.features.learned.installation import check_keypoints
from maplab_py.vision.features.learned.lighterglue import (
    ImageKeypoints,
    LighterGlue,
    installed_lighterglue,
)
from maplab_py.vision.features.learned.lighterglue_graph import lighterglue_graph
from tests.support.small_xfeat import random_matcher_arrays, xfeat_or_skip

pytest.importorskip("onnx", reason="the extra [learned] is not installed")
pytest.importorskip("onnxruntime", reason="the extra [learned] is not installed")


@pytest.fixture(scope="module")
def network() -> LighterGlue:
    return LighterGlue(lighterglue_graph(random_matcher_arrays(), "random"), "random")


def softmax(x: F64) -> F64:
    weight = np.exp(x - x.max(axis=1, keepdims=True))
    return np.asarray(weight / weight.sum(axis=1, keepdims=True))


class Plain:
    """The network in a few lines, as its authors define it, for two images without padding."""

    def __init__(self, arrays: Arrays) -> None:
        self.arrays = {
            key.removeprefix("matcher."): value.astype(np.float64) for key, value in arrays.items()
        }

    def linear(self, x: F64, name: str) -> F64:
        return x @ self.arrays[f"{name}.weight"].T + self.arrays[f"{name}.bias"]

    def update(self, x: F64, message: F64, name: str) -> F64:
        from scipy.special import erf

        hidden = self.linear(np.concatenate([x, message], axis=1), f"{name}.ffn.0")
        mean, variance = hidden.mean(axis=1, keepdims=True), hidden.var(axis=1, keepdims=True)
        hidden = (hidden - mean) / np.sqrt(variance + 1e-5)
        hidden = hidden * self.arrays[f"{name}.ffn.1.weight"] + self.arrays[f"{name}.ffn.1.bias"]
        hidden = 0.5 * hidden * (1.0 + erf(hidden / np.sqrt(2.0)))
        return x + self.linear(hidden, f"{name}.ffn.3")

    def within(self, x: F64, angle: F64, name: str) -> F64:
        q, k, v = np.moveaxis(self.linear(x, f"{name}.Wqkv").reshape(len(x), -1, 3), 2, 0)
        q, k = turned(q, angle), turned(k, angle)
        context = softmax(q @ k.T / np.sqrt(q.shape[1])) @ v
        return self.update(x, self.linear(context, f"{name}.out_proj"), name)

    def across(self, x: F64, y: F64, name: str) -> F64:
        q, k = self.linear(x, f"{name}.to_qk"), self.linear(y, f"{name}.to_qk")
        context = softmax(q @ k.T / np.sqrt(q.shape[1])) @ self.linear(y, f"{name}.to_v")
        return self.update(x, self.linear(context, f"{name}.to_out"), name)

    def scores(self, pair: tuple[ImageKeypoints, ImageKeypoints]) -> F64:
        sides, angles = [], []
        for image in pair:
            size = np.array(image.size_px)
            place = (image.uv_px - size / 2) / (size.max() / 2)
            angles.append(place @ self.arrays["posenc.Wr.weight"].T)
            sides.append(self.linear(image.descriptors.astype(np.float64), "input_proj"))
        for row in range(6):
            name = f"transformers.{row}"
            x, y = (
                self.within(side, angle, f"{name}.self_attn")
                for side, angle in zip(sides, angles, strict=True)
            )
            sides = [
                self.across(x, y, f"{name}.cross_attn"),
                self.across(y, x, f"{name}.cross_attn"),
            ]
        a, b = (self.linear(side, "log_assignment.5.final_proj") for side in sides)
        product = a @ b.T / np.sqrt(a.shape[1])
        seen = [1 / (1 + np.exp(-self.linear(side, "log_assignment.5.matchability")))
                for side in sides]  # fmt: skip
        return np.log(softmax(product) * softmax(product.T).T * seen[0] * seen[1].T)


def turned(x: F64, angle: F64) -> F64:
    """Return pairs of numbers (N, 2 F) turned by angles (N, F)."""
    first, second = x[:, ::2], x[:, 1::2]
    cosine, sine = np.cos(angle), np.sin(angle)
    both = [first * cosine - second * sine, second * cosine + first * sine]
    return np.stack(both, axis=2).reshape(x.shape)


def test_the_graph_computes_the_network(network: LighterGlue) -> None:
    first, second = check_keypoints()
    wanted = Plain(random_matcher_arrays()).scores((first, second))
    (got,) = network.scores([(first, second)])
    assert got.shape == wanted.shape == (24, 20)
    assert np.abs(got - wanted).max() < 1e-4 * np.abs(wanted).max()


def test_pairs_of_different_sizes_run_together(
    network: LighterGlue, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = check_keypoints()
    few = ImageKeypoints(first.uv_px[:7], first.descriptors[:7], first.size_px)
    none = ImageKeypoints(first.uv_px[:0], first.descriptors[:0], first.size_px)
    pairs = [(first, second), (few, second), (none, second), (second, few), (none, none)]
    together = network.scores(pairs)
    monkeypatch.setattr("maplab_py.vision.features.learned.lighterglue._NUMBERS_AT_ONCE", 1)
    alone = network.scores(pairs)
    assert [each.shape for each in together] == [(24, 20), (7, 20), (0, 20), (20, 7), (0, 0)]
    assert all(np.allclose(a, b, atol=2e-4) for a, b in zip(together, alone, strict=True))
    rows, columns = network.match(pairs)[2]
    assert len(rows) == len(columns) == 0


def test_checkpoints_of_other_networks_are_refused() -> None:
    arrays: dict[str, Any] = dict(random_matcher_arrays())
    arrays["matcher.transformers.3.self_attn.Wqkv.bias"] = np.zeros(7, dtype=np.float32)
    with pytest.raises(UserError, match=r"mine: is no checkpoint of LighterGlue: .*Wqkv\.bias"):
        lighterglue_graph(arrays, "mine")


def test_installed_weights_match_a_moved_image() -> None:
    extractor = xfeat_or_skip()
    try:
        matcher = installed_lighterglue()
    except UserError as error:
        pytest.skip(f"needs the weights: {error}")
    rng = np.random.default_rng(3)
    rough = np.kron(rng.integers(30, 220, (24, 32)), np.ones((10, 10))).astype(np.uint8)
    images = rough[:192, :256], (rough[16:208, 8:264] * 0.4).astype(np.uint8)
    a, b = (
        ImageKeypoints(each.keypoints_px, np.asarray(each.descriptors), (256, 192))
        for each in (extractor.extract(image, 200) for image in images)
    )
    ((i, j),) = matcher.match([(a, b)])
    is_right = np.linalg.norm(a.uv_px[i] - b.uv_px[j] - [8.0, 16.0], axis=1) < 1.5
    assert np.count_nonzero(is_right) > 80
    assert np.mean(is_right) > 0.9
