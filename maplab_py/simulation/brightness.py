"""Brightness of the images of a session: light, and the gain of the cameras."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.array_types import F64
from maplab_py.simulation.scenario import SessionImages

_GAIN_PERIOD_S = 7.0


@dataclasses.dataclass(frozen=True, eq=False)
class Brightness:
    """By which grey values are multiplied; the same for all cameras of a rig."""

    light: float = 1.0
    swing: float = 0.0  # of the gain, slowly to and fro
    jump_s: F64 = dataclasses.field(default_factory=lambda: np.zeros(0))  # (J,) when the gain jumps
    gain: F64 = dataclasses.field(default_factory=lambda: np.ones(1))  # (J + 1,) before and after

    def at(self, time_s: float) -> float:
        """Return the factor at a time [s]."""
        swing = 1.0 + self.swing * np.sin(2.0 * np.pi * time_s / _GAIN_PERIOD_S)
        jump = self.gain[np.searchsorted(self.jump_s, time_s, side="right")]
        return float(self.light * swing * jump)


def make_brightness(
    options: SessionImages, swing: float, duration_s: float, rng: np.random.Generator
) -> Brightness:
    """Draw when the gain of a session jumps (a Poisson process), and to which values."""
    if options.gain_jump_every_s == 0.0 or options.gain_jump == 0.0:
        return Brightness(options.light, swing)
    count = rng.poisson(duration_s / options.gain_jump_every_s)
    jump_s = np.sort(rng.uniform(0.0, duration_s, count))
    gain = 1.0 + options.gain_jump * rng.uniform(-1.0, 1.0, count + 1)
    gain[0] = 1.0
    return Brightness(options.light, swing, jump_s, gain)
