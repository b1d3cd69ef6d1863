"""Samples of the images of one camera: figures of the light, and points that two images share."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.array_types import F64, I64, U8, Mask, Rows
from maplab_py.interop.recordings.protocol import TrackedFrame
from maplab_py.sensors import Camera
from maplab_py.vision.features import detection, images
from maplab_py.vision.features.options import FeatureOptions
from maplab_py.vision.tracking.flow import FlowOptions, follow

MOST_POINTS = 120
"""Points of a pair of images."""
_WIDEST_PX = 800.0
"""Wider images are halved, or more: a check needs no more detail."""
_FLOW = FlowOptions(patch_size_px=15, levels=4, forward_backward_px=0.5)
_DARK, _BRIGHT = 12, 250
"""Grey values up to which a pixel is black, and from which on it is white."""
_SHORTEST_S, _LONGEST_S = 0.09, 0.6
"""Times between the images of a pair."""
_LEAST_SHARED = 12
_BLUR_SCALE = 4


@dataclasses.dataclass(frozen=True)
class ImageFigures:
    """Figures of one image."""

    time_ns: int
    mean_grey: float
    dark_share: float  # of pixels that are black
    bright_share: float  # of pixels that are white
    sharpness: float  # of the contrast across edges of four pixels, the share of the steepest pixel
    corners: int
    is_repeated: bool  # the same pixels as the image before


class PointPairs(Rows):
    """Points of one camera in P pairs of images; rows are padded to the same length."""

    first_ns: I64  # (P,)
    second_ns: I64  # (P,)
    uv_px: F64  # (P, K, 2, 2) by pair, point and image
    is_point: Mask  # (P, K)

    @classmethod
    def stack(cls, pairs: list[tuple[int, int, F64]]) -> PointPairs:
        """Stack pairs of images, given as times and points (K, 2, 2)."""
        width = max((len(uv) for _, _, uv in pairs), default=1)
        uv_px, is_point = (
            np.zeros((len(pairs), width, 2, 2)),
            np.zeros((len(pairs), width), np.bool_),
        )
        for row, (_, _, uv) in enumerate(pairs):
            uv_px[row, : len(uv)], is_point[row, : len(uv)] = uv, True
        times = np.array([(first, second) for first, second, _ in pairs], dtype=np.int64)
        first_ns, second_ns = times.reshape(-1, 2).T
        return cls(first_ns, second_ns, uv_px, is_point)


class CameraSampler:
    """Takes images of one camera, and follows points from each to the next."""

    def __init__(self, camera: Camera, row: int) -> None:
        factor = 1.0
        while camera.width_px * factor > _WIDEST_PX:
            factor *= 0.5
        options = FeatureOptions(detector_max_feature_count=MOST_POINTS, image_resize_factor=factor)
        self._preparation = images.ImagePreparation.of(camera, row, options)
        self._detector = detection.GridDetector(options, self._preparation.usable)
        self.figures: list[ImageFigures] = []
        self.pairs: list[tuple[int, int, F64]] = []
        self._last: tuple[int, U8, F64] | None = None
        self._last_tracked: TrackedFrame | None = None
        self._last_time_ns = 0

    def is_due(self, time_ns: int) -> bool:
        """Return whether an image is far enough from the one before."""
        return not self._last_time_ns or time_ns - self._last_time_ns >= _SHORTEST_S * 1e9

    def add(self, time_ns: int, grey: U8) -> None:
        """Take an image (H, W) of 8 bits."""
        image, before = self._preparation.prepare(grey), self._last
        uv = detection.refined(image, self._detector.detect(image, np.zeros((0, 2))))
        is_repeated = before is not None and np.array_equal(before[1], image)
        self.figures.append(figures_of(time_ns, image, len(uv), is_repeated))
        if before is not None and time_ns - before[0] <= _LONGEST_S * 1e9:
            there, is_tracked = follow(before[1], image, before[2], before[2], _FLOW)
            both = np.stack([before[2][is_tracked], there[is_tracked]], axis=1)
            recorded = self._preparation.to_recorded(both.reshape(-1, 2)).reshape(-1, 2, 2)
            if len(recorded) >= _LEAST_SHARED:
                self.pairs.append((before[0], time_ns, recorded))
        self._last, self._last_time_ns = (time_ns, image, uv), time_ns

    def add_repeat(self, time_ns: int, grey: U8) -> None:
        """Take the image that follows directly, only to see whether it is the same again."""
        if self._last is None:
            return
        same = np.array_equal(self._preparation.prepare(grey), self._last[1])
        last = self.figures[-1]
        self.figures.append(dataclasses.replace(last, time_ns=time_ns, is_repeated=same))

    def add_tracks(self, frame: TrackedFrame, time_ns: int) -> None:
        """Take tracked keypoints in place of an image."""
        before, last_ns = self._last_tracked, self._last_time_ns
        self._last_tracked, self._last_time_ns = frame, time_ns
        if before is None or time_ns - last_ns > _LONGEST_S * 1e9:
            return
        _, i, j = np.intersect1d(before.track_id, frame.track_id, return_indices=True)
        i, j = (rows[before.track_id[i] >= 0][:MOST_POINTS] for rows in (i, j))
        if len(i) >= _LEAST_SHARED:
            uv = np.stack([before.uv_px[i], frame.uv_px[j]], axis=1)
            self.pairs.append((last_ns, time_ns, uv))


def figures_of(time_ns: int, image: U8, corners: int, is_repeated: bool) -> ImageFigures:
    """Return the figures of an image (H, W)."""
    values = image[::2, ::2]
    step = np.abs(np.diff(image[::2].astype(np.int16), axis=1))
    width = step.shape[1] - _BLUR_SCALE + 1
    parts = np.stack([step[:, i : i + width] for i in range(_BLUR_SCALE)])
    far = np.abs(image[::2, _BLUR_SCALE:].astype(np.int16) - image[::2, :-_BLUR_SCALE])
    # edges alone: the noise of an even surface has as much detail in a blurred image
    edge = far >= max(float(np.percentile(far, 98.0)), 1.0)
    sharp = parts.max(axis=0)[edge].mean() / far[edge].mean() if edge.any() else 0.0
    return ImageFigures(
        time_ns,
        float(values.mean()),
        float(np.mean(values <= _DARK)),
        float(np.mean(values >= _BRIGHT)),
        float(sharp),
        corners,
        is_repeated,
    )
