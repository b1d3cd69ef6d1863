"""Odometry and map building while a recording is read: from camera and IMU to a native map.

A driver makes an `Odometry`, pushes samples and images, and gives the updates to a `MapBuilder`; a
`Mapping` does both for a recording. docs/record_your_own_map.md has an example.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from maplab_py.frontend.map_builder import MapBuilder
    from maplab_py.frontend.mapping import Mapping
    from maplab_py.frontend.odometry import Odometry
    from maplab_py.frontend.odometry_options import OdometryOptions
    from maplab_py.frontend.odometry_update import OdometryUpdate
    from maplab_py.frontend.run_options import MapBuilderOptions, RunOptions

_IMPORTED_ON_USE = {
    "MapBuilder": "map_builder",
    "MapBuilderOptions": "run_options",
    "Mapping": "mapping",
    "Odometry": "odometry",
    "OdometryOptions": "odometry_options",
    "OdometryUpdate": "odometry_update",
    "RunOptions": "run_options",
}
"""Modules that the declaration of flags does not wait for."""

__all__ = [
    "MapBuilder",
    "MapBuilderOptions",
    "Mapping",
    "Odometry",
    "OdometryOptions",
    "OdometryUpdate",
    "RunOptions",
]


def __getattr__(name: str) -> Any:
    """Import a class when it is asked for."""
    if name in _IMPORTED_ON_USE:
        return getattr(importlib.import_module(f"{__name__}.{_IMPORTED_ON_USE[name]}"), name)
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
