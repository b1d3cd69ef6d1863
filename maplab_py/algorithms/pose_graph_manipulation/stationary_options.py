"""Criteria for a mission at rest, with maplab's flag names."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from maplab_py.options import option


@dataclasses.dataclass(frozen=True)
class StationaryOptions:
    """Criteria for a mission at rest."""

    flag_prefix: ClassVar[str] = "maplab_stationary_submaps_"

    max_rotation_rad: float = option(
        0.15, help="Largest angle between the first and any other vertex.", unit="rad"
    )
    max_translation_m: float = option(
        0.10, help="Largest distance between the first and any other vertex.", unit="m"
    )
