"""Signs of a camera that is covered, frozen or out of focus, compared with what it has shown before."""

import collections

import numpy as np

from maplab_py.algorithms.recording_check.image_samples import figures_of
from maplab_py.array_types import U8

_EVERY_NS = 200_000_000
_SAMPLES, _FEWEST = 25, 4
"""Samples that are remembered, five seconds, and from which on a camera is known."""
_EVERY_ROW = 3
_REPEATED = 2
_COVERED_SHARE, _COVERED_CONTRAST = 0.25, 10.0
"""A covered camera has less than this share of its contrast, and less than this deviation of grey values."""
_BLURRED, _SHARP = 0.298, 0.335
"""Share of the contrast of an edge of four pixels in its steepest one: 0.25 of a ramp. Images of MH_01 have
0.31 to 0.57, with a blur of four pixels 0.27 to 0.28."""
_LASTING = 3
"""Samples for which the images must be bad, or good again."""


class ImageWatch:
    """Watches the images of one camera."""

    def __init__(self) -> None:
        self._last: U8 | None = None
        self._next_ns, self._repeats, self._since_ns = 0, 0, 0
        self._contrast: collections.deque[float] = collections.deque(maxlen=_SAMPLES)
        self._sharpness: collections.deque[float] = collections.deque(maxlen=_SAMPLES)
        self._signs: collections.deque[tuple[int, str]] = collections.deque(maxlen=_LASTING)
        self.sign = ""  # what is wrong now
        self.since_ns = 0

    def push(self, time_ns: int, image: U8, *, is_moving: bool) -> None:
        """Take an image (H, W); a camera that repeats itself while the device moves is frozen."""
        is_same = self._last is not None and np.array_equal(self._last, image)
        self._last = image
        if not is_same or not self._repeats:
            self._since_ns = time_ns
        self._repeats = self._repeats + 1 if is_same else 0
        if self._repeats >= _REPEATED and is_moving:
            self.sign, self.since_ns = "frozen", self._since_ns
        elif not is_same and self.sign == "frozen":
            self.sign = ""
        if not is_same and time_ns >= self._next_ns:
            self._next_ns = time_ns + _EVERY_NS
            self._sample(time_ns, image)

    def _sample(self, time_ns: int, image: U8) -> None:
        """Compare contrast and sharpness with those of before."""
        contrast = float(image[::4, ::4].std())
        sharpness = figures_of(time_ns, image[::_EVERY_ROW], 0, False).sharpness
        sign = ""
        if len(self._contrast) >= _FEWEST:
            if contrast < min(_COVERED_SHARE * float(np.median(self._contrast)), _COVERED_CONTRAST):
                sign = "covered"
            elif sharpness < _BLURRED and float(np.median(self._sharpness)) > _SHARP:
                sign = "out of focus"
        self._signs.append((time_ns, sign))
        if not sign and not self.sign:
            self._contrast.append(contrast)
            self._sharpness.append(sharpness)
        lasting = {name for _, name in self._signs}
        if len(self._signs) == _LASTING and len(lasting) == 1 and self.sign != "frozen":
            if sign and not self.sign:
                self.since_ns = self._signs[0][0]
            self.sign = sign
