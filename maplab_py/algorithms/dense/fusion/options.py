"""Options of the fusion of depth; names are those of maplab where it has them."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from maplab_py.options import option

MESH_MIN_WEIGHT = 2.5
"""Weight from which a voxel counts as observed, in measurements at a depth of 2 m."""


@dataclasses.dataclass(frozen=True)
class FusionOptions:
    """Grid of truncated signed distances, and the weights of measurements."""

    flag_prefix: ClassVar[str] = "dense_tsdf_"

    voxel_size_m: float = option(0.10, help="Side of a voxel", unit="m")
    truncation_distance_m: float = option(
        0.0, help="Distances are limited to this; 0 = three voxels", unit="m"
    )
    min_ray_length_m: float = option(0.2, help="Smallest depth that is used", unit="m")
    max_ray_length_m: float = option(6.0, help="Largest depth that is used", unit="m")
    weight_depth_power: int = option(
        4,
        help="The weight of a measurement falls with this power of its depth: 4 for stereo, whose "
        "variance grows with it, 2 or 0 for depth sensors",
    )
    max_weight: float = option(10000.0, help="Largest weight of a voxel")
    integrate_every_nth: int = option(1, help="Integrate every n-th depth map only")

    def __post_init__(self) -> None:
        """Check the ranges."""
        if self.voxel_size_m <= 0.0 or self.truncation_distance_m < 0.0:
            raise ValueError(
                "--dense_tsdf_voxel_size_m must be positive, --dense_tsdf_truncation_distance_m 0 or "
                "greater"
            )
        if not 0.0 < self.min_ray_length_m < self.max_ray_length_m:
            raise ValueError(
                "0 < --dense_tsdf_min_ray_length_m < --dense_tsdf_max_ray_length_m must hold"
            )
        if not 0 <= self.weight_depth_power <= 8 or self.integrate_every_nth < 1:
            raise ValueError(
                "--dense_tsdf_weight_depth_power must be 0 to 8, --dense_tsdf_integrate_every_nth 1 or "
                "greater"
            )
        if self.max_weight <= 0.0:
            raise ValueError("--dense_tsdf_max_weight must be positive")

    @property
    def truncation_m(self) -> float:
        """The truncation distance [m]."""
        return self.truncation_distance_m or 3.0 * self.voxel_size_m
