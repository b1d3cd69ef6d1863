"""XFeat descriptors of corners of images, by onnxruntime.

The network sees the image at sides of multiples of 32 pixels. Descriptors are sampled where
its authors sample them: the centres of its cells lie half a pixel off towards the borders of the image.
"""

from __future__ import annotations

import numpy as np

from maplab_py.array_types import F32, F64, U8
from maplab_py.vision.features import detection, extension
from maplab_py.vision.features.learned import networks, xfeat_graph

_APART_PX = 5.0
_MIN_SHARE = 1e-3
"""Strength of the weakest corner relative to the strongest one, so that less light keeps them."""
_CUBIC = -0.75
"""Slope of the interpolating cubic, that of PyTorch."""


def installed_xfeat() -> XFeat:
    """Return the network that `install_features xfeat` has installed; opened once.

    Raises:
        UserError: It is not installed or damaged, or onnxruntime is missing.
    """
    return networks.installed("XFeat", XFeat)


class XFeat:
    """The network, ready to run; threads may use it at the same time."""

    def __init__(self, network: bytes, name: str) -> None:
        """Open the network.

        Args:
            network: Content of the file, as `xfeat_graph` makes it.
            name: Name of the file, for messages.

        Raises:
            UserError: onnxruntime cannot open it, or is not installed.
        """
        self._session = networks.open_network(network, name)

    def descriptor_map(self, image: U8 | F32) -> F32:
        """Return descriptors (H / 8, W / 8, 64) of an image (H, W) with sides of multiples of 32."""
        pixels = image[None, None].astype(np.float32)
        return np.asarray(self._session.run(["descriptors"], {"image": pixels})[0][0])

    def extract(self, image: U8, max_features: int) -> extension.ExtractedFeatures:
        """Return the strongest corners of an image (H, W) with their descriptors, the strongest first."""
        uv_px = _corners(image, max_features)
        by_rank = np.arange(len(uv_px), 0.0, -1.0)
        return extension.ExtractedFeatures(uv_px, by_rank, self.describe(image, uv_px))

    def describe(self, image: U8, uv_px: F64) -> F32:
        """Return the descriptors (K, 64) of keypoints (K, 2) of an image (H, W)."""
        if not len(uv_px):
            return np.zeros((0, xfeat_graph.DIMENSIONS), dtype=np.float32)
        prepared, scale = _prepare(image)
        return _bicubic(
            self.descriptor_map(prepared), _cells((uv_px + 0.5) / scale - 0.5, prepared.shape)
        )


def _prepare(image: U8) -> tuple[F32, F64]:
    """Return an image with sides that are multiples of 32, and its pixels (2,) per pixel of those."""
    import cv2

    size = np.array(image.shape[::-1])
    wanted = np.maximum(size // xfeat_graph.SIZE_STEP_PX, 1) * xfeat_graph.SIZE_STEP_PX
    prepared = np.asarray(image, dtype=np.float32)
    if (wanted != size).any():
        prepared = np.asarray(
            cv2.resize(prepared, wanted.tolist(), interpolation=cv2.INTER_LINEAR), dtype=np.float32
        )
    return prepared, size / wanted


def _corners(image: U8, most: int) -> F64:
    """Return corners (K, 2), the strongest first, to a fraction of a pixel."""
    import cv2

    corners = cv2.goodFeaturesToTrack(np.ascontiguousarray(image), most, _MIN_SHARE, _APART_PX)
    if corners is None:
        return np.zeros((0, 2))
    return detection.strongest_places(image, corners.reshape(-1, 2).astype(np.int64))


def _cells(uv: F64, shape: tuple[int, ...]) -> F64:
    """Return where pixels (K, 2) of an image (H, W) lie among its cells, as the network was trained."""
    sides = np.array(shape[::-1])
    return np.asarray(uv * (sides / xfeat_graph.CELL_PX) / (sides - 1) - 0.5)


def _bicubic(values: F32, where: F64) -> F32:
    """Return vectors (h, w, D) at places (K, 2), zero outside, scaled to unit length (K, D)."""
    height, width, dimensions = values.shape
    base = np.floor(where).astype(np.int64)
    weight = _cubic_weights(where - base)  # (K, 2, 4)
    taps = base[:, :, None] + np.arange(-1, 3)
    inside = (taps >= 0) & (taps < np.array([[width], [height]]))
    weight = np.where(inside, weight, 0.0).astype(np.float32)
    taps = np.where(inside, taps, 0)
    rows = taps[:, 1, :, None] * width + taps[:, 0, None, :]
    near = values.reshape(-1, dimensions)[rows.reshape(len(where), 16)]
    both = (weight[:, 1, :, None] * weight[:, 0, None, :]).reshape(len(where), 1, 16)
    sampled = np.matmul(both, near)[:, 0]
    length = np.sqrt(np.einsum("kd,kd->k", sampled, sampled))[:, None]
    return np.asarray(sampled / np.maximum(length, 1e-12), dtype=np.float32)


def _cubic_weights(share: F64) -> F64:
    """Return the weights (..., 4) of the four neighbours of a place between the second and the third.

    Source: R. Keys, Cubic convolution interpolation, 1981.
    """
    a = _CUBIC
    near, far = np.stack([share, 1.0 - share]), np.stack([1.0 + share, 2.0 - share])
    inner = ((a + 2.0) * near - (a + 3.0)) * near * near + 1.0
    outer = ((a * far - 5.0 * a) * far + 8.0 * a) * far - 4.0 * a
    return np.stack([outer[0], inner[0], inner[1], outer[1]], axis=-1)
