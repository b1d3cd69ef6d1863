"""Options of the split into cells."""

from maplab_py.options import Options, option


class CellOptions(Options, prefix="cell_"):
    """Number of cells and their overlap."""

    count: int = option(4, ge=1)
    """Number of cells; each has about as many vertices of its own."""
    overlap_m: float = option(5.0, ge=0)
    """Horizontal distance from a cell up to which its neighbours' vertices are in it, too."""
