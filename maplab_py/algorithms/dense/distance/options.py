"""Options of Euclidean distance fields; names are those of maplab where it has them."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import ClassVar

from maplab_py.options import option


@dataclasses.dataclass(frozen=True)
class DistanceOptions:
    """Reach of distances, and free space near the robot."""

    flag_prefix: ClassVar[str] = "dense_esdf_"

    max_distance_m: float = option(2.0, help="Distances are limited to this", unit="m")
    use_clear_sphere: bool = option(
        False,
        help="Around every camera, count voxels that no depth map has observed as free inside the inner "
        "radius, and as occupied between it and the outer radius",
    )
    clear_sphere_inner_radius: float = option(0.3, help="Inner radius", unit="m")
    clear_sphere_outer_radius: float = option(1.0, help="Outer radius", unit="m")
    export_map_for_panning_path: Path | None = option(
        None,
        help="Also write the voxels for a path planner: a .ply cloud of their centres in the global frame "
        "with the distance as intensity",
    )

    def __post_init__(self) -> None:
        """Check the ranges."""
        if not 0.0 < self.max_distance_m < float("inf"):
            raise ValueError("--dense_esdf_max_distance_m must be positive")
        if not 0.0 <= self.clear_sphere_inner_radius <= self.clear_sphere_outer_radius:
            raise ValueError(
                "0 <= --dense_esdf_clear_sphere_inner_radius <= --dense_esdf_clear_sphere_outer_radius "
                "must hold"
            )
