"""Matches of XFeat features between two images by the network LighterGlue."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from maplab_py.array_types import F32, F64, I64
from maplab_py.vision.features.learned.lighterglue_graph import DIMENSIONS
from maplab_py.vision.features.learned.networks import installed, open_network

_MIN_PROBABILITY = 0.1
"""Of a match, that of the authors."""
_ABSENT = -1e4
"""Logarithm of the weight of rows that no keypoint has."""
_NUMBERS_AT_ONCE = 1 << 23
"""Of an attention between all keypoints of all pairs that are run together; a few such exist at a time."""


@dataclasses.dataclass(frozen=True, eq=False)
class ImageKeypoints:
    """Keypoints of an image with descriptors."""

    uv_px: F64  # (K, 2)
    descriptors: F32  # (K, 64) unit
    size_px: tuple[int, int]  # width, height of the image


Pair = tuple[ImageKeypoints, ImageKeypoints]


def installed_lighterglue() -> LighterGlue:
    """Return the network that `install_features xfeat` has installed; opened once.

    Raises:
        UserError: It is not installed or damaged, or onnxruntime is missing.
    """
    return installed("LighterGlue", LighterGlue)


class LighterGlue:
    """The network, ready to run; threads may use it at the same time."""

    def __init__(self, network: bytes, name: str) -> None:
        """Open the network.

        Args:
            network: Content of the file, as `lighterglue_graph` makes it.
            name: Name of the file, for messages.

        Raises:
            UserError: onnxruntime cannot open it, or is not installed.
        """
        self._session = open_network(network, name)

    def match(self, pairs: Sequence[Pair]) -> list[tuple[I64, I64]]:
        """Return the rows of matched keypoints of both images, ascending in the first, for each pair."""
        return [_mutual(scores) for scores in self.scores(pairs)]

    def scores(self, pairs: Sequence[Pair]) -> list[F32]:
        """Return, for each pair, logarithms of the probabilities (K, L) that keypoints are the same point.

        Pairs of images with about as many keypoints run together.
        """
        result = [np.zeros((len(a.uv_px), len(b.uv_px)), dtype=np.float32) for a, b in pairs]
        size = np.array([max(each.shape) if each.size else 0 for each in result], dtype=np.int64)
        order = np.argsort(size, kind="stable")[np.count_nonzero(size == 0) :]
        while len(order):
            most = int(size[order[-1]])
            some = order[-max(_NUMBERS_AT_ONCE // (2 * most * most), 1) :]
            order = order[: -len(some)]
            scores = self._run([pairs[row] for row in some], most)
            for row, values in zip(some, scores, strict=True):
                height, width = result[row].shape
                result[row] = values[:height, :width]
        return result

    def _run(self, pairs: list[Pair], most: int) -> F32:
        """Return scores (P, most, most) of pairs of images with up to as many keypoints."""
        places = np.zeros((2, len(pairs), most, 2), dtype=np.float32)
        descriptors = np.zeros((2, len(pairs), most, DIMENSIONS), dtype=np.float32)
        absence = np.full((2, len(pairs), 1, most), _ABSENT, dtype=np.float32)
        for number, pair in enumerate(pairs):
            for side, image in enumerate(pair):
                count, size = len(image.uv_px), np.array(image.size_px)
                places[side, number, :count] = (image.uv_px - size / 2) / (size.max() / 2)
                descriptors[side, number, :count] = image.descriptors
                absence[side, number, :, :count] = 0.0
        inputs = {"places": places, "descriptors": descriptors, "absence": absence}
        return np.asarray(self._session.run(["scores"], inputs)[0])


def _mutual(scores: F32) -> tuple[I64, I64]:
    """Return rows and columns of entries that are the largest of both and large enough."""
    if not scores.size:
        none = np.zeros(0, dtype=np.int64)
        return none, none
    best = np.argmax(scores, axis=1)
    row = np.arange(len(best))
    kept = (np.argmax(scores, axis=0)[best] == row) & (scores[row, best] > np.log(_MIN_PROBABILITY))
    return row[kept], best[kept]
