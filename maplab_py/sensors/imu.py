"""The inertial measurement unit: noise, saturation, gravity, and scale / misalignment."""

import dataclasses
from typing import Any

import numpy as np

from maplab_py.array_types import F64, Mask

TRIANGLE_NAMES = {
    "x scale": (0, 0),
    "y scale": (1, 1),
    "z scale": (2, 2),
    "xy misalignment": (0, 1),
    "xz misalignment": (0, 2),
    "yz misalignment": (1, 2),
}
"""Names of the entries of the upper triangular matrices, in the order of the estimated parameters."""


def _identity() -> F64:
    return np.eye(3)


@dataclasses.dataclass(frozen=True, eq=False)
class ImuIntrinsics:
    """Scale, misalignment and internal rotation (Schneider 2019, eq. 7.7-7.10).

    w_measured = T_g w_I + b_g;  a_measured = T_a R_AI R_IG (a_G - g_G) + b_a, T upper triangular.
    """

    T_g: F64 = dataclasses.field(default_factory=_identity)
    T_a: F64 = dataclasses.field(default_factory=_identity)
    R_A_I: F64 = dataclasses.field(default_factory=_identity)


@dataclasses.dataclass(frozen=True, eq=False)
class Imu:
    """IMU parameters; defaults are maplab's."""

    id: str
    acc_noise_density: float = 4e-3  # [m/s^2/sqrt(Hz)]
    acc_bias_random_walk_noise_density: float = 4e-3  # [m/s^3/sqrt(Hz)]
    gyro_noise_density: float = 1e-4  # [rad/s/sqrt(Hz)]
    gyro_bias_random_walk_noise_density: float = 1e-4  # [rad/s^2/sqrt(Hz)]
    saturation_accel_max_mps2: float = 150.0
    saturation_gyro_max_radps: float = 7.5
    gravity_magnitude_mps2: float = 9.81
    intrinsics: ImuIntrinsics | None = None  # None = identity
    topic: str = ""
    description: str = ""
    extra: dict[str, Any] = dataclasses.field(default_factory=dict)

    def is_saturated(self, accel_gyro: F64) -> Mask:
        """Return which samples (N, 6) [m/s^2, rad/s] reach a limit of the sensor on some axis."""
        limits = np.repeat([self.saturation_accel_max_mps2, self.saturation_gyro_max_radps], 3)
        return np.asarray(np.any(np.abs(accel_gyro) >= limits, axis=1))


def gravity_mps2(latitude_deg: float, altitude_m: float) -> float:
    """Return gravity on the WGS 84 ellipsoid (Somigliana) with the free-air gradient [m/s^2]."""
    sine2 = np.sin(np.radians(latitude_deg)) ** 2
    at_sea = 9.7803253359 * (1 + 0.00193185265241 * sine2) / np.sqrt(1 - 0.00669437999013 * sine2)
    return float(at_sea - 3.086e-6 * altitude_m)
