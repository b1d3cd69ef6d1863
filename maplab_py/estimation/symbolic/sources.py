"""The residual functions by name, importable without casadi: it is loaded when one is made."""

from collections.abc import Callable
from enum import Enum
from typing import Any


class PoseError(Enum):
    """Kind of residual of an edge of a pose graph."""

    SPLIT = (
        "split"  # [p_A_B - p_measured, Log(R_measured^T R_A_B)], as covariances of maps are meant
    )
    LOGARITHM = "logarithm"  # Log(T_measured^-1 T_A_B) in SE(3), as public files are meant


def _function(name: str, **settings: bool) -> Callable[[], Any]:
    """Return what makes the casadi function of a residual, loading casadi only then."""

    def make() -> Any:
        from maplab_py.estimation.symbolic import residuals

        return getattr(residuals, name)(**settings)

    return make


inertial = _function("inertial")
inertial_with_intrinsics = _function("inertial", with_intrinsics=True)
relative_pose = _function("relative_pose")
relative_pose_with_mounting = _function("relative_pose", with_mounting=True)
scaled_relative_pose = _function("scaled_relative_pose")
scaled_relative_pose_with_mounting = _function("scaled_relative_pose", with_mounting=True)
absolute_pose = _function("absolute_pose")
absolute_pose_with_mounting = _function("absolute_pose", with_mounting=True)
switched_relative_pose = _function("switched_relative_pose")
