"""Tables: frozen dataclasses of numpy arrays that share their first axis."""

import dataclasses
from collections.abc import Sequence
from typing import Any, ClassVar, Self, dataclass_transform

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from maplab_py.array_types import I64, Rows


def column(dtype: DTypeLike, *shape: int, fill: Any = 0) -> Any:
    """Declare one column: rows of `shape` entries of `dtype`; -1 in the shape takes any width.

    Args:
        dtype: Type of the entries.
        shape: Shape of one row, empty for a scalar column.
        fill: Value that `Table.filled` gives to a column which was not named (one row or a scalar).
    """
    return dataclasses.field(metadata={"dtype": np.dtype(dtype), "shape": shape, "fill": fill})


@dataclass_transform(frozen_default=True, eq_default=False, field_specifiers=(column,))
class Table:
    """Base of all tables. Columns are read-only: an edit makes a new table that shares the rest."""

    __dataclass_fields__: ClassVar[dict[str, dataclasses.Field[Any]]]

    def __init_subclass__(cls) -> None:
        dataclasses.dataclass(frozen=True, eq=False)(cls)

    def __post_init__(self) -> None:
        """Check dtypes and shapes, and lock the columns against writing."""
        length = -1
        for field in dataclasses.fields(self):
            array = np.asarray(getattr(self, field.name), dtype=field.metadata["dtype"])
            length = array.shape[0] if length < 0 else length
            wanted = field.metadata["shape"]
            fits = len(array.shape) == 1 + len(wanted) and all(
                w in (-1, n) for w, n in zip(wanted, array.shape[1:], strict=True)
            )
            if not fits or array.shape[0] != length:
                raise ValueError(
                    f"{type(self).__name__}.{field.name}: shape {array.shape} does not fit "
                    f"{length} rows of {wanted}"
                )
            if array.flags.writeable:
                array = array.view()
                array.flags.writeable = False
            object.__setattr__(self, field.name, array)

    def __len__(self) -> int:
        first = dataclasses.fields(self)[0].name
        return int(getattr(self, first).shape[0])

    @classmethod
    def filled(cls, length: int, **columns: ArrayLike) -> Self:
        """Make a table of `length` rows; columns that are not given get their fill value."""
        values: dict[str, Any] = {}
        for field in dataclasses.fields(cls):
            if field.name in columns:
                values[field.name] = columns.pop(field.name)
                continue
            row = tuple(max(n, 0) for n in field.metadata["shape"])
            array = np.empty((length, *row), dtype=field.metadata["dtype"])
            array[...] = field.metadata["fill"]
            values[field.name] = array
        if columns:
            raise TypeError(f"{cls.__name__} has no column {', '.join(sorted(columns))}")
        return cls(**values)

    @classmethod
    def empty(cls) -> Self:
        """Make a table without rows."""
        return cls.filled(0)

    def replace(self, **columns: ArrayLike) -> Self:
        """Return a table with some columns exchanged and all others shared."""
        return dataclasses.replace(self, **columns)

    def put(self, rows: Any, **values: ArrayLike) -> Self:
        """Return a table with other values of some columns in some rows (indices or a boolean mask)."""
        columns = {name: np.array(getattr(self, name)) for name in values}
        for name, value in values.items():
            columns[name][rows] = value
        return self.replace(**columns)

    def take(self, rows: ArrayLike) -> Self:
        """Return the table of the given rows (indices or a boolean mask)."""
        index = np.asarray(rows)
        return type(self)(**{name: array[index] for name, array in self.columns().items()})

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return the columns by name."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}

    @classmethod
    def concatenate(cls, tables: list[Self]) -> Self:
        """Stack tables; columns of free width are padded with zeros to the widest."""
        if not tables:
            return cls.empty()
        names = [field.name for field in dataclasses.fields(cls)]
        return cls(**{n: _stack([getattr(table, n) for table in tables]) for n in names})

    def nbytes(self) -> int:
        """Return the memory of all columns in bytes."""
        return sum(array.nbytes for array in self.columns().values())


def stacked_columns(
    tables: list[dict[str, NDArray[Any]]], rows: NDArray[np.int64] | None = None
) -> dict[str, NDArray[Any]]:
    """Stack the columns of tables, and reorder the rows where an order is given.

    Every column is taken out of `tables` before the next is stacked: only one is in memory twice.
    """
    result = {}
    for name in list(tables[0]) if tables else ():
        column = _stack([table.pop(name) for table in tables])
        result[name] = column if rows is None else column[rows]
    return result


def _stack(arrays: list[NDArray[Any]]) -> NDArray[Any]:
    if len(arrays) == 1:
        return arrays[0]
    if arrays[0].ndim == 2:
        width = max(array.shape[1] for array in arrays)
        arrays = [
            array
            if array.shape[1] == width
            else np.pad(array, ((0, 0), (0, width - array.shape[1])))
            for array in arrays
        ]
    return np.concatenate(arrays)


def object_column(values: Sequence[Any]) -> NDArray[Any]:
    """Make a column of Python objects (N,), tuples among them."""
    return np.fromiter(values, dtype=object, count=len(values))


def ragged_rows(start: NDArray[np.int64], rows: NDArray[Any]) -> NDArray[np.int64]:
    """Return the item indices that belong to the given rows of a CSR layout, in row order.

    Args:
        start: Offsets (N + 1): items of row i are start[i] .. start[i + 1] - 1.
        rows: Row indices (M,).
    """
    counts = start[1:][rows] - start[:-1][rows]
    ends = np.cumsum(counts)
    total = int(ends[-1]) if len(ends) else 0
    shift = np.repeat(start[:-1][rows] - (ends - counts), counts)
    return np.asarray(np.arange(total, dtype=np.int64) + shift)


def connected_groups(first: NDArray[Any], second: NDArray[Any], count: int) -> I64:
    """Return the group (count,), numbered from 0, of rows that pairs of rows (N,) connect."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    links = coo_array((np.ones(len(first), dtype=np.int8), (first, second)), shape=(count, count))
    return np.asarray(connected_components(links, directed=False)[1], dtype=np.int64)


def starts_of_counts(counts: NDArray[Any]) -> NDArray[np.int64]:
    """Turn counts (N,) into CSR offsets (N + 1,)."""
    start = np.zeros(len(counts) + 1, dtype=np.int64)
    np.cumsum(counts, out=start[1:])
    return start


class Groups(Rows):
    """Base of dataclasses of groups (N) of items (CSR): the fields `items` have one row per item."""

    items = tuple[str, ...]()
    start: I64  # (N + 1,): items of group i are rows start[i] .. start[i + 1] - 1

    def __init_subclass__(cls, items: tuple[str, ...] = (), **rest: Any) -> None:
        """Name the fields of items."""
        super().__init_subclass__(**rest)
        cls.items = items

    def __len__(self) -> int:
        return len(self.start) - 1

    def take(self, rows: NDArray[Any] | slice) -> Self:
        """Return some of the groups with their items."""
        groups = np.arange(len(self))[rows]
        items = ragged_rows(self.start, groups)
        arrays = {n: a for n, a in self._arrays().items() if n != "start"}
        taken = {n: array[items if n in self.items else groups] for n, array in arrays.items()}
        start = starts_of_counts(np.diff(self.start)[groups])
        return dataclasses.replace(self, **taken, start=start)

    @classmethod
    def concatenate(cls, parts: Sequence[Self]) -> Self:
        """Return the groups of one part after another."""
        counts = np.concatenate([np.diff(part.start) for part in parts])
        return dataclasses.replace(super().concatenate(parts), start=starts_of_counts(counts))
