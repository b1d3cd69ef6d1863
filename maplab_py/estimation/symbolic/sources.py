"""The residual functions by name, importable without casadi: it is loaded when one is made."""

from __future__ import annotations

from typing import Any


def inertial() -> Any:
    """Make the casadi function of an inertial edge."""
    from maplab_py.estimation.symbolic import residuals

    return residuals.inertial()


def inertial_with_intrinsics() -> Any:
    """Make the casadi function of an inertial edge whose IMU is being calibrated."""
    from maplab_py.estimation.symbolic import residuals

    return residuals.inertial(with_intrinsics=True)


def relative_pose() -> Any:
    """Make the casadi function of a relative pose."""
    from maplab_py.estimation.symbolic import residuals

    return residuals.relative_pose()


def relative_pose_with_mounting() -> Any:
    """Make the casadi function of a relative pose of a sensor whose mounting is estimated."""
    from maplab_py.estimation.symbolic import residuals

    return residuals.relative_pose(with_mounting=True)


def absolute_pose() -> Any:
    """Make the casadi function of an absolute pose."""
    from maplab_py.estimation.symbolic import residuals

    return residuals.absolute_pose()


def absolute_pose_with_mounting() -> Any:
    """Make the casadi function of an absolute pose of a sensor whose mounting is estimated."""
    from maplab_py.estimation.symbolic import residuals

    return residuals.absolute_pose(with_mounting=True)


def switched_relative_pose() -> Any:
    """Make the casadi function of a relative pose with a switch."""
    from maplab_py.estimation.symbolic import residuals

    return residuals.switched_relative_pose()
