"""Compile the kernels of the simulator by rendering a tiny image."""

from __future__ import annotations

import numpy as np

from maplab_py.array_types import F64
from maplab_py.geometry import se3
from maplab_py.sensors import Camera, Distortion, Projection
from maplab_py.simulation.imaging import Brightness, Imager
from maplab_py.simulation.ray_caster import painted_boxes
from maplab_py.simulation.scenario import ImageOptions
from maplab_py.simulation.scene import make_scene

RENDERING = "image rendering"


def compile_rendering() -> None:
    """Compile the ray caster and the formation of images."""
    options, rng = ImageOptions(texel_m=0.1), np.random.default_rng(0)
    room = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
    scene = make_scene(room, 0.1 * room[None] + 0.5, options, rng)
    camera = Camera(
        "0" * 32,
        Projection.PINHOLE,
        Distortion.NONE,
        np.array([8.0, 8.0, 8.0, 8.0]),
        np.zeros(0),
        16,
        16,
    )

    def at_time(time_s: F64) -> F64:
        return se3.identity(len(time_s))

    imager = Imager.of(painted_boxes(scene), camera, options, 0.0, at_time, Brightness())
    imager.image(0.0, rng)
