"""One camera: projection, distortion and their parameters."""

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
    DOUBLE_SPHERE = "double-sphere"  # intrinsics xi alpha fu fv cu cv
    EXTENDED_UNIFIED = "extended-unified"  # intrinsics alpha beta fu fv cu cv


class Distortion(Enum):
    """Distortion models (values: names in sensors.yaml)."""

    NONE = "none"
    RADTAN = "radial-tangential"  # k1 k2 p1 p2
    RADTAN5 = "radial-tangential-5"  # k1 k2 p1 p2 k3: OpenCV, plumb_bob of ROS
    RATIONAL = "rational-polynomial"  # k1 k2 p1 p2 k3 k4 k5 k6: OpenCV, ROS
    EQUIDISTANT = "equidistant"  # k1 k2 k3 k4
    FOV = "fisheye"  # w


MIRROR_NAMES: dict[Projection, tuple[str, ...]] = {
    Projection.PINHOLE: (),
    Projection.UNIFIED: ("xi",),
    Projection.DOUBLE_SPHERE: ("xi", "alpha"),
    Projection.EXTENDED_UNIFIED: ("alpha", "beta"),
}
"""Names of the intrinsics before fu fv cu cv."""
INTRINSICS_SIZE = {model: len(names) + 4 for model, names in MIRROR_NAMES.items()}
DISTORTION_NAMES: dict[Distortion, tuple[str, ...]] = {
    Distortion.NONE: (),
    Distortion.RADTAN: ("k1", "k2", "p1", "p2"),
    Distortion.RADTAN5: ("k1", "k2", "p1", "p2", "k3"),
    Distortion.RATIONAL: ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    Distortion.EQUIDISTANT: ("k1", "k2", "k3", "k4"),
    Distortion.FOV: ("w",),
}
DISTORTION_SIZE = {model: len(names) for model, names in DISTORTION_NAMES.items()}
_WITHOUT_DISTORTION = (Projection.DOUBLE_SPHERE, Projection.EXTENDED_UNIFIED)
CAMERA_MODELS = tuple(
    (projection, distortion)
    for projection in Projection
    for distortion in Distortion
    if projection not in _WITHOUT_DISTORTION or distortion is Distortion.NONE
)
"""Every camera model: double sphere and extended unified have no distortion."""


def is_known_to_maplab(projection: Projection, distortion: Distortion) -> bool:
    """Return whether C++ maplab has a camera model."""
    added = Distortion.RADTAN5, Distortion.RATIONAL
    return projection not in _WITHOUT_DISTORTION and distortion not in added


def parameter_names(projection: Projection, distortion: Distortion) -> list[tuple[str, str]]:
    """Return name and unit of every entry of the intrinsics and the distortion parameters."""
    mirror = [(f"mirror {name}", "") for name in MIRROR_NAMES[projection]]
    pinhole = [(f"{what} {axis}", "px") for what in ("focal length", "centre") for axis in "uv"]
    return [*mirror, *pinhole, *((f"distortion {k}", "") for k in DISTORTION_NAMES[distortion])]


@dataclasses.dataclass(frozen=True, eq=False)
class Camera:
    """A calibrated camera. Pixels are of the distorted image; the optical axis is +z of C."""

    id: str  # 32 hexadecimal digits
    projection: Projection
    distortion: Distortion
    intrinsics: NDArray[np.float64]  # [mirror..., fu fv cu cv] [px], see `MIRROR_NAMES`
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

    @property
    def central_focal_px(self) -> NDArray[np.float64]:
        """Focal lengths (2,) of a pinhole camera with the same magnification in the centre."""
        has_shift = self.projection in (Projection.UNIFIED, Projection.DOUBLE_SPHERE)
        return np.asarray(self.intrinsics[-4:-2] / (1.0 + self.intrinsics[0] * has_shift))

    def __post_init__(self) -> None:
        """Check the parameter counts, and that the projection is one to one."""
        if (self.projection, self.distortion) not in CAMERA_MODELS:
            raise MapError(
                f"camera {self.id}: {self.projection.value} takes no distortion, "
                f"not {self.distortion.value}: give it the distortion type none"
            )
        wanted = INTRINSICS_SIZE[self.projection], DISTORTION_SIZE[self.distortion]
        given = len(self.intrinsics), len(self.distortion_parameters)
        if wanted != given:
            raise MapError(
                f"camera {self.id}: {self.projection.value} with {self.distortion.value} distortion "
                f"needs {wanted[0]} + {wanted[1]} parameters, not {given[0]} + {given[1]}"
            )
        mirror = self.intrinsics[:-4]
        if self.projection is Projection.DOUBLE_SPHERE and not (
            -1.0 < mirror[0] <= 1.0 and 0.0 <= mirror[1] <= 1.0
        ):
            raise MapError(
                f"camera {self.id}: {self.projection.value} needs -1 < xi <= 1 and "
                f"0 <= alpha <= 1, not {mirror[0]:g} and {mirror[1]:g}"
            )
        if self.projection is Projection.EXTENDED_UNIFIED and not (
            0.0 <= mirror[0] <= 1.0 and mirror[1] > 0.0
        ):
            raise MapError(
                f"camera {self.id}: {self.projection.value} needs 0 <= alpha <= 1 and "
                f"beta > 0, not {mirror[0]:g} and {mirror[1]:g}"
            )


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
