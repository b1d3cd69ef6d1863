"""Speed of keypoints in the presence of noise.

Keypoints at rest differ from image to image by their noise, whatever the time between the images; moving
ones differ the more, the longer that is. Two baselines tell one from the other: with noise n and rate r the
disparity over a time T is sqrt(n^2 + (r T)^2). The noise that the tracker states is not used: trackers
that follow an image repeat themselves at rest.
"""

from __future__ import annotations

import collections
import dataclasses
import itertools

import numpy as np

from maplab_py.array_types import F64, I32, I64
from maplab_py.estimation.window.frame import WindowFrame
from maplab_py.vision.tracking.tracks import TrackedImages

_MIN_TRACKS = 8
_MAX_NOISE_PX = 2.0
"""Median disparity from image to image above which it is not noise (0.8 px of each keypoint: 1.3)."""


@dataclasses.dataclass(frozen=True, eq=False)
class Keypoints:
    """Keypoints of a rig at one time."""

    time_ns: int
    key: I64  # (K,) of track and camera
    uv_px: F64  # (K, 2)

    @classmethod
    def of_frame(cls, frame: WindowFrame) -> Keypoints:
        """Take those of a frame of the window."""
        return cls(frame.time_ns, _keys(frame.track_id, frame.camera), frame.uv_px)

    @classmethod
    def of_images(cls, tracked: TrackedImages) -> Keypoints:
        """Take those of all cameras."""
        keys = [_keys(c.track_id, np.int32(row)) for row, c in enumerate(tracked.cameras)]
        pixels = [c.uv_px for c in tracked.cameras]
        none = np.zeros(0, dtype=np.int64)
        return cls(
            tracked.time_ns,
            np.concatenate([none, *keys]),
            np.concatenate([np.zeros((0, 2)), *pixels]),
        )


@dataclasses.dataclass(frozen=True)
class Rate:
    """Noise and motion of keypoints over some time, turns included; NaN = too few common tracks."""

    px_per_s: float
    noise_px: float  # median disparity that two images of a body at rest would have


UNKNOWN = Rate(float("nan"), float("nan"))


def disparity_px(first: Keypoints, second: Keypoints) -> float:
    """Return the median disparity of common tracks; NaN when there are too few."""
    _, i, j = np.intersect1d(first.key, second.key, return_indices=True)
    if len(i) < _MIN_TRACKS:
        return float("nan")
    return float(np.median(np.linalg.norm(second.uv_px[j] - first.uv_px[i], axis=1)))


def rate(short_px: F64, short_s: float, long_px: F64, long_s: F64) -> Rate:
    """Separate motion from noise.

    Args:
        short_px: Disparities (N,) over neighbouring images.
        short_s: Mean time between them.
        long_px: Disparities (M,) over longer times; the fastest motion counts. NaN = unknown.
        long_s: These times (M,), longer than the short one.
    """
    is_known = np.isfinite(long_px)
    if not len(short_px) or not np.isfinite(short_px).all() or not is_known.any():
        return UNKNOWN
    long_px, long_s = long_px[is_known], long_s[is_known]
    near2 = float(np.median(short_px)) ** 2
    speed2 = float(np.max((long_px**2 - near2) / (long_s**2 - short_s**2)))
    # disparity from image to image that is too large for noise is an oscillation
    speed2 = max(speed2, (near2 - _MAX_NOISE_PX**2) / short_s**2, 0.0)
    noise2 = max(near2 - speed2 * short_s**2, 0.0)
    return Rate(float(np.sqrt(speed2)), float(np.sqrt(noise2)))


class RecentKeypoints:
    """The keypoints of the latest images, to see how fast they move."""

    def __init__(self, time_s: float) -> None:
        """Keep the images of so many seconds."""
        self._time_ns = round(time_s * 1e9)
        self._images: collections.deque[Keypoints] = collections.deque()
        self._steps_px: collections.deque[float] = collections.deque()  # to the image before

    def push(self, keypoints: Keypoints) -> None:
        """Add the next image."""
        images = self._images
        self._steps_px.append(disparity_px(images[-1], keypoints) if images else float("nan"))
        images.append(keypoints)
        # images are not exactly in step with the time
        while len(images) > 2 and keypoints.time_ns - images[1].time_ns >= 0.95 * self._time_ns:
            images.popleft()
            self._steps_px.popleft()

    def clear(self) -> None:
        """Forget all images."""
        self._images.clear()
        self._steps_px.clear()

    @property
    def newest_px(self) -> float:
        """Disparity between the two newest images, NaN when it is not known."""
        return self._steps_px[-1] if self._steps_px else float("nan")

    @property
    def is_complete(self) -> bool:
        """Whether there are images of nine tenths of the time, and three at least."""
        images = self._images
        if len(images) < 3:
            return False
        return images[-1].time_ns - images[0].time_ns >= 0.9 * self._time_ns

    def rates(self) -> tuple[Rate, Rate]:
        """Compare the newest of three images or more with one from half the time ago, and with the oldest."""
        images = self._images
        age_s = np.array([images[-1].time_ns - image.time_ns for image in images]) * 1e-9
        steps_px = np.array(list(itertools.islice(self._steps_px, 1, None)))
        step_s = float(age_s[0]) / (len(images) - 1)
        # two steps or more
        half = min(int(np.searchsorted(-age_s, -0.5 * age_s[0])), len(images) - 3)
        rates = [
            rate(
                steps_px, step_s,
                np.array([disparity_px(images[row], images[-1])]), age_s[row : row + 1],
            )
            for row in (half, 0)
        ]  # fmt: skip
        return rates[0], rates[1]


def _keys(track_id: I64, camera: I32 | np.int32) -> I64:
    return np.asarray(track_id.astype(np.int64) * 256 + camera, dtype=np.int64)
