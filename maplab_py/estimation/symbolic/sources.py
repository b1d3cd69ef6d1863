"""The residual functions by name, importable without casadi: it is loaded when one is made."""

from __future__ import annotations

from typing import Any


def inertial() -> Any:
    """Make the casadi function of an inertial edge."""
    from maplab_py.estimation.symbolic import residuals

    return residuals.inertial()


def relative_pose() -> Any:
    """Make the casadi function of a relative pose."""
    from maplab_py.estimation.symbolic import residuals

    return residuals.relative_pose()


def absolute_pose() -> Any:
    """Make the casadi function of an absolute pose."""
    from maplab_py.estimation.symbolic import residuals

    return residuals.absolute_pose()
