"""Criteria for a mission at rest, with maplab's flag names."""

from maplab_py.options import Options


class StationaryOptions(Options, prefix="maplab_stationary_submaps_"):
    """Criteria for a mission at rest."""

    max_rotation_rad: float = 0.15
    """Largest angle between the first and any other vertex."""
    max_translation_m: float = 0.10
    """Largest distance between the first and any other vertex."""
