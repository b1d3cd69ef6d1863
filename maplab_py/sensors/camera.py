"""One camera: projection, distortion and their parameters."""

from __future__ import annotations

import dataclasses
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maplab_py.errors import MapError


class Projection(Enum):
    """Projection models (values: names in sensors.yaml)."""

    PINHOLE = "pinhole"  # intrinsics fu fv cu cv
    UNIFIED = "unified-projection"  # intrinsics xi fu fv cu cv


class Distortion(Enum):
    """Distortion models (values: names in sensors.yaml)."""

    NONE = "none"
    RADTAN = "radial-tangential"  # k1 k2 p1 p2
    EQUIDISTANT = "equidistant"  # k1 k2 k3 k4
    FOV = "fisheye"  # w


INTRINSICS_SIZE = {Projection.PINHOLE: 4, Projection.UNIFIED: 5}
DISTORTION_NAMES: dict[Distortion, tuple[str, ...]] = {
    Distortion.NONE: (),
    Distortion.RADTAN: ("k1", "k2", "p1", "p2"),
    Distortion.EQUIDISTANT: ("k1", "k2", "k3", "k4"),
    Distortion.FOV: ("w",),
}
DISTORTION_SIZE = {model: len(names) for model, names in DISTORTION_NAMES.items()}


def parameter_names(projection: Projection, distortion: Distortion) -> list[tuple[str, str]]:
    """Return name and unit of every entry of the intrinsics and the distortion parameters."""
    mirror = [("mirror xi", "")] if projection is Projection.UNIFIED else []
    pinhole = [(f"{what} {axis}", "px") for what in ("focal length", "centre") for axis in "uv"]
    return [*mirror, *pinhole, *((f"distortion {k}", "") for k in DISTORTION_NAMES[distortion])]


@dataclasses.dataclass(frozen=True, eq=False)
class Camera:
    """A calibrated camera. Pixels are of the distorted image; the optical axis is +z of C."""

    id: str  # 32 hexadecimal digits
    projection: Projection
    distortion: Distortion
    intrinsics: NDArray[np.float64]  # [fu fv cu cv] [px], unified: [xi fu fv cu cv]
    distortion_parameters: NDArray[np.float64]
    width_px: int
    height_px: int
    topic: str = ""
    description: str = ""
    time_offset_ns: int = 0  # t_imu = t_camera + offset
    image_delay_s: float = 0.0  # first rows were taken this much after their vertices' times
    line_delay_ns: int = 0  # from each row of a rolling shutter to the next; 0 = global shutter
    extra: dict[str, Any] = dataclasses.field(default_factory=dict)  # keys not understood

    @property
    def is_moving(self) -> bool:
        """Whether pixels are of other times than their vertices."""
        return self.image_delay_s != 0.0 or self.line_delay_ns != 0

    def delay_s(self, uv_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how much later than its vertex each pixel (N, 2) was taken (N,) [s]."""
        return self.image_delay_s + 1e-9 * self.line_delay_ns * uv_px[:, 1]

    def __post_init__(self) -> None:
        """Check the parameter counts."""
        wanted = INTRINSICS_SIZE[self.projection], DISTORTION_SIZE[self.distortion]
        given = len(self.intrinsics), len(self.distortion_parameters)
        if wanted != given:
            raise MapError(
                f"camera {self.id}: {self.projection.value} with {self.distortion.value} distortion "
                f"needs {wanted[0]} + {wanted[1]} parameters, not {given[0]} + {given[1]}"
            )
