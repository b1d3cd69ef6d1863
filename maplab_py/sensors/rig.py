"""A rig of rigidly mounted cameras (maplab's NCamera)."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maplab_py.sensors.camera import Camera


@dataclasses.dataclass(frozen=True, eq=False)
class CameraRig:
    """Cameras with their poses on the rig's body frame B."""

    id: str
    cameras: tuple[Camera, ...]
    T_B_C: NDArray[np.float64]  # (number of cameras, 7)
    topic: str = ""
    description: str = ""
    extra: dict[str, Any] = dataclasses.field(default_factory=dict)
    camera_extra: tuple[dict[str, Any], ...] = ()  # per camera: other keys beside T_B_C, or empty
