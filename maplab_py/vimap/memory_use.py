"""Memory of the columns of several maps, shared ones counted once."""

import dataclasses
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maplab_py.vimap.table import Table
from maplab_py.vimap.vi_map import VIMap


class SharedColumns:
    """Bytes of several maps; a shared column counts for the first map only."""

    def __init__(self) -> None:
        self._seen: set[tuple[int, int]] = set()

    def add(
        self, vi_map: VIMap, size_of: Callable[[NDArray[Any]], int] = lambda array: array.nbytes
    ) -> int:
        """Return the bytes of the columns of a map that no map before has.

        Args:
            size_of: Bytes of a column that count.
        """
        total = 0
        for array in _columns(vi_map):
            place = int(array.__array_interface__["data"][0]), array.nbytes
            if array.nbytes and place not in self._seen:
                self._seen.add(place)
                total += size_of(array)
        return total

    def add_all(self, maps: Iterable[VIMap]) -> int:
        """Return the bytes of the columns of maps that no map before has."""
        return sum(self.add(vi_map) for vi_map in maps)


def forget_lookups(vi_map: VIMap) -> None:
    """Free what a map has derived from its columns; it is computed again on demand."""
    fields = {field.name for field in dataclasses.fields(vi_map)}
    for name in [name for name in vars(vi_map) if name not in fields]:
        vars(vi_map).pop(name, None)


def _columns(vi_map: VIMap) -> Iterator[NDArray[Any]]:
    for field in dataclasses.fields(vi_map):
        table = getattr(vi_map, field.name)
        if isinstance(table, Table):
            yield from (np.asarray(column) for column in table.columns().values())
