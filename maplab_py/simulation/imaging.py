"""Image formation: exposure, motion blur, vignette, noise."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Self

import numpy as np

from maplab_py.array_types import F32, F64, U8
from maplab_py.compilation import compiled
from maplab_py.sensors import Camera
from maplab_py.simulation.brightness import Brightness
from maplab_py.simulation.pixel_rays import pixel_rays
from maplab_py.simulation.ray_caster import RayCaster
from maplab_py.simulation.scenario import ImageOptions
from maplab_py.simulation.shading_kernels import FAST, PaintedBoxes


@dataclasses.dataclass(frozen=True, eq=False)
class Imager:
    """One camera that looks at a scene."""

    caster: RayCaster
    options: ImageOptions
    brightness: Brightness
    line_delay_s: float
    at_time: Callable[[F64], F64]  # poses T_G_C (N, 7) at times (N,) [s]
    vignette: F32  # (H, W)

    @classmethod
    def of(
        cls,
        painted: PaintedBoxes,
        camera: Camera,
        options: ImageOptions,
        line_delay_s: float,
        at_time: Callable[[F64], F64],
        brightness: Brightness,
    ) -> Self:
        """Invert the camera model once for all images."""
        centre = np.array([camera.width_px, camera.height_px]) / 2.0
        v, u = np.mgrid[0 : camera.height_px, 0 : camera.width_px]
        radius2 = ((u - centre[0]) ** 2 + (v - centre[1]) ** 2) / np.sum(centre**2)
        vignette = (1.0 - options.vignette * radius2).astype(np.float32)
        focal_px = float(np.mean(camera.intrinsics[-4:-2]))
        caster = RayCaster.of(painted, pixel_rays(camera), focal_px)
        return cls(caster, options, brightness, line_delay_s, at_time, vignette)

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
        for number in range(samples):
            # the middle sample lies nearest to the image's time
            far = depth if number == samples // 2 else any_depth
            self.caster.add(T_G_C[number], 1.0 / samples, light, far)
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
