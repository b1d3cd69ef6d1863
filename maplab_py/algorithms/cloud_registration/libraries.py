"""The libraries of the extra `lidar`, imported where they are needed."""

from __future__ import annotations

from functools import cache
from typing import Any

from maplab_py.errors import UserError

_REMEDY = "pip install 'maplab-py[lidar]'"


@cache
def small_gicp() -> Any:
    """Return the library that registers clouds from initial poses.

    Raises:
        UserError: It is not installed.
    """
    try:
        import small_gicp as library
    except ImportError:
        raise UserError(f"registration of clouds needs the library small_gicp: {_REMEDY}") from None
    return library


@cache
def kiss_matcher() -> Any:
    """Return the library that registers clouds without initial poses.

    Raises:
        UserError: It is not installed.
    """
    try:
        import kiss_matcher as library
    except ImportError:
        raise UserError(f"--lidar_lc_global needs the library kiss_matcher: {_REMEDY}") from None
    return library
