"""Options of the split into cells."""

from __future__ import annotations

from maplab_py.errors import FlagError
from maplab_py.options import Options


class CellOptions(Options, prefix="cell_"):
    """Number of cells and their overlap."""

    count: int = 4
    """Number of cells; each has about as many vertices of its own."""
    overlap_m: float = 5.0
    """Horizontal distance from a cell up to which its neighbours' vertices are in it, too."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            FlagError: A value is out of range.
        """
        if self.count < 1:
            raise FlagError(f"--cell_count={self.count}: a map has at least one cell")
        if not 0.0 <= self.overlap_m < float("inf"):
            raise FlagError(f"--cell_overlap_m={self.overlap_m:g} must be finite and not negative")
