"""Options of the split into cells."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from maplab_py.errors import FlagError
from maplab_py.options import option


@dataclasses.dataclass(frozen=True)
class CellOptions:
    """Number of cells and their overlap."""

    flag_prefix: ClassVar[str] = "cell_"

    count: int = option(4, help="Number of cells; each has about as many vertices of its own.")
    overlap_m: float = option(
        5.0,
        help="Horizontal distance from a cell up to which its neighbours' vertices are in it, too.",
        unit="m",
    )

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            FlagError: A value is out of range.
        """
        if self.count < 1:
            raise FlagError(f"--cell_count={self.count}: a map has at least one cell")
        if not 0.0 <= self.overlap_m < float("inf"):
            raise FlagError(f"--cell_overlap_m={self.overlap_m:g} must be finite and not negative")
