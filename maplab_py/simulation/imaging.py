"""Image formation: exposure, motion blur, vignette, noise."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Self

import numpy as np

from maplab_py.array_types import F32, F64, U8
from maplab_py.compilation import compiled
from maplab_py.errors import UserError
from maplab_py.sensors import Camera, projection
from maplab_py.simulation.cameras import pixels_of
from maplab_py.simulation.ray_caster import RayCaster
from maplab_py.simulation.scenario import ImageOptions, SessionImages
from maplab_py.simulation.shading_kernels import FAST, PaintedBoxes
from maplab_py.simulation.walkers import Walkers


@dataclasses.dataclass(frozen=True, eq=False)
class Imager:
    """One camera that looks at a scene."""

    caster: RayCaster
    options: ImageOptions
    brightness: Brightness
    line_delay_s: float
    at_time: Callable[[F64], F64]  # poses T_G_C (N, 7) at times (N,) [s]
    vignette: F32  # (H, W)
    walkers: Walkers | None = None

    @classmethod
    def of(
        cls,
        painted: PaintedBoxes,
        camera: Camera,
        options: ImageOptions,
        line_delay_s: float,
        at_time: Callable[[F64], F64],
        brightness: Brightness,
        walkers: Walkers | None = None,
    ) -> Self:
        """Invert the camera model once for all images."""
        centre = np.array([camera.width_px, camera.height_px]) / 2.0
        v, u = np.mgrid[0 : camera.height_px, 0 : camera.width_px]
        radius2 = ((u - centre[0]) ** 2 + (v - centre[1]) ** 2) / np.sum(centre**2)
        vignette = (1.0 - options.vignette * radius2).astype(np.float32)
        focal_px = float(np.mean(camera.central_focal_px))
        caster = RayCaster.of(painted, pixel_rays(camera), focal_px)
        return cls(caster, options, brightness, line_delay_s, at_time, vignette, walkers)

    def image(self, time_s: float, rng: np.random.Generator) -> tuple[U8, F32]:
        """Return the image (H, W) taken about a time, and the depth (H, W) [m] at that time.

        Light is gathered during the exposure; each row at its own time where the shutter rolls.
        """
        options, shape = self.options, self.vignette.shape
        rows = np.arange(shape[0]) - 0.5 * shape[0] if self.line_delay_s else np.zeros(1)
        samples = max(1, options.blur_samples)
        shifts_s = options.exposure_s * ((np.arange(samples) + 0.5) / samples - 0.5)
        row_s = time_s + self.line_delay_s * rows
        T_G_C = self.at_time((row_s + shifts_s[:, None]).ravel()).reshape(samples, -1, 7)
        light = np.zeros(shape, dtype=np.float32)
        depth, any_depth = np.zeros_like(light), np.zeros_like(light)
        caster = self.caster
        if self.walkers is not None:
            moved = self.walkers.moved(caster.painted, time_s)
            caster = dataclasses.replace(caster, painted=moved)
        for number in range(samples):
            # the middle sample lies nearest to the image's time
            far = depth if number == samples // 2 else any_depth
            caster.add(T_G_C[number], 1.0 / samples, light, far)
        noise = rng.standard_normal(shape, dtype=np.float32)
        image = np.empty(shape, dtype=np.uint8)
        gain, sigma = np.float32(self.brightness.at(time_s)), np.float32(options.noise_sigma)
        _expose(light, self.vignette, gain, noise, sigma, image)
        return image, depth


@compiled(**FAST)
def _expose(light, vignette, gain, noise, sigma, image):  # type: ignore[no-untyped-def]
    """Fill in an image (H, W) of 8 bits from the light (H, W), with noise (H, W) of unit variance."""
    for row in range(light.shape[0]):
        for column in range(light.shape[1]):
            value = gain * vignette[row, column] * light[row, column] + sigma * noise[row, column]
            value = np.rint(value)
            value = np.float32(0.0) if value < np.float32(0.0) else value
            image[row, column] = np.uint8(np.float32(255.0) if value > np.float32(255.0) else value)


_MAX_MISS_PX = 1e-6
_LARGEST_RADIUS = 5.0
"""Pixels with a larger angle to the optical axis (79 deg) are black."""


def pixel_rays(camera: Camera) -> F64:
    """Return the points (H, W, 2) on the plane z = 1 that the pixel centres show; NaN = none.

    The camera model's inverse counts where the simulator's projection confirms it.

    Raises:
        UserError: No pixel has a ray.
    """
    v, u = np.mgrid[0 : camera.height_px, 0 : camera.width_px].astype(np.float64)
    uv = np.stack([u.ravel(), v.ravel()], axis=1)
    rays, valid = projection.back_project(camera, uv)
    x = rays[:, :2] / np.where(valid & (rays[:, 2] > 0.0), rays[:, 2], np.nan)[:, None]
    again = pixels_of(camera, np.concatenate([x, np.ones((len(x), 1))], axis=1))
    is_known = np.linalg.norm(again - uv, axis=1) < _MAX_MISS_PX
    is_known &= np.linalg.norm(x, axis=1) <= _LARGEST_RADIUS
    if not is_known.any():
        raise UserError("cameras: no pixel of the image can be inverted to a ray")
    x[~is_known] = np.nan
    return np.asarray(x.reshape(camera.height_px, camera.width_px, 2))


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
