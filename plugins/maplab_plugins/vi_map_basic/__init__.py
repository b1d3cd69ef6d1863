"""maplab's vi_map_basic plugin: maps in memory and on disk, their content, undo."""

from maplab_plugins.vi_map_basic import (
    cells,
    information,
    loading,
    maps,
    reproduction,
    resources,
    saving,
)

__all__ = ["cells", "information", "loading", "maps", "reproduction", "resources", "saving"]
