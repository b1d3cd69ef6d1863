"""From light to a camera's image: exposure, blur by motion, vignette, noise."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from maplab_py.sensors import Camera
from maplab_py.simulation.rendering import Scene, pixel_rays, render
from maplab_py.simulation.scenario import ImageOptions

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

_GAIN_PERIOD_S = 7.0


@dataclasses.dataclass(frozen=True, eq=False)
class Imager:
    """One camera that looks at a scene."""

    scene: Scene
    camera: Camera
    options: ImageOptions
    line_delay_s: float
    at_time: Callable[[F64], F64]  # poses T_G_C (N, 7) at times (N,) [s]
    rays: F64  # (H, W, 2)
    vignette: F32  # (H, W)

    @classmethod
    def of(
        cls,
        scene: Scene,
        camera: Camera,
        options: ImageOptions,
        line_delay_s: float,
        at_time: Callable[[F64], F64],
    ) -> Imager:
        """Invert the camera model once for all images."""
        centre = np.array([camera.width_px, camera.height_px]) / 2.0
        v, u = np.mgrid[0 : camera.height_px, 0 : camera.width_px]
        radius2 = ((u - centre[0]) ** 2 + (v - centre[1]) ** 2) / np.sum(centre**2)
        vignette = (1.0 - options.vignette * radius2).astype(np.float32)
        rays = pixel_rays(camera)
        return cls(scene, camera, options, line_delay_s, at_time, rays, vignette)

    def image(self, time_s: float, rng: np.random.Generator) -> tuple[NDArray[np.uint8], F32]:
        """Return the image (H, W) taken about a time, and the depth (H, W) [m] at that time.

        Light is gathered during the exposure; each row at its own time where the shutter rolls.
        """
        options = self.options
        rows = np.arange(self.camera.height_px) - 0.5 * self.camera.height_px
        row_s = time_s + self.line_delay_s * rows
        samples = max(1, options.blur_samples)
        shifts = (np.arange(samples) + 0.5) / samples - 0.5
        light = np.zeros(self.vignette.shape, dtype=np.float32)
        depth = light
        for number, shift in enumerate(shifts * options.exposure_s):
            poses = self.at_time(row_s + shift)
            grey, far = render(self.scene, self.rays, self._focal_px, poses)
            light += grey / samples
            # the middle sample lies nearest to the image's time
            depth = far if number == samples // 2 else depth
        gain = 1.0 + options.gain_swing * np.sin(2.0 * np.pi * time_s / _GAIN_PERIOD_S)
        noise = options.noise_sigma * rng.standard_normal(light.shape, dtype=np.float32)
        values = np.round(gain * self.vignette * light + noise)
        return np.clip(values, 0.0, 255.0).astype(np.uint8), depth

    @property
    def _focal_px(self) -> float:
        return float(np.mean(self.camera.intrinsics[-4:-2]))
