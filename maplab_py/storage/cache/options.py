"""Options of the cache of loaded maps."""

from maplab_py.options import Options, option


class CacheOptions(Options):
    """Whether the columns of loaded maps are kept for the next load, and how much of them."""

    map_cache: bool = False
    """Keep the columns of the map in the user's cache folder, and map them into memory from there at the next
    load as long as the files of the map are the same."""
    map_cache_max_gb: float = option(20.0, gt=0)
    """Size of the cache of maps; those that were not loaded for the longest time are deleted."""
