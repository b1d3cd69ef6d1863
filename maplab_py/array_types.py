"""Names of the types of arrays, one for the whole project, and the base of tables in memory."""

import dataclasses
from collections.abc import Sequence
from typing import Any, ClassVar, Self, dataclass_transform

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
I64 = NDArray[np.int64]
I32 = NDArray[np.int32]
U64 = NDArray[np.uint64]
U32 = NDArray[np.uint32]
U8 = NDArray[np.uint8]
I8 = NDArray[np.int8]
Mask = NDArray[np.bool_]

__all__ = ["F32", "F64", "I8", "I32", "I64", "U8", "U32", "U64", "Mask", "NDArray", "Rows"]
__all__ += ["mask_of"]


def mask_of(count: int, rows: Any) -> Mask:
    """Return which of `count` rows are among some rows (indices, or a mask)."""
    mask = np.zeros(count, dtype=np.bool_)
    mask[rows] = True
    return mask


@dataclass_transform(frozen_default=True, eq_default=False)
class Rows:
    """Base of frozen dataclasses whose arrays share their first axis; other fields are of all rows."""

    __dataclass_fields__: ClassVar[dict[str, dataclasses.Field[Any]]]

    def __init_subclass__(cls) -> None:
        dataclasses.dataclass(frozen=True, eq=False)(cls)

    def __len__(self) -> int:
        values = vars(self)
        return next(
            len(values[name])
            for name in self.__dataclass_fields__
            if isinstance(values[name], np.ndarray)
        )

    def take(self, rows: NDArray[np.integer] | Mask | slice) -> Self:
        """Return some of the rows."""
        values = vars(self)
        rest = {name: values[name] for name in self.__dataclass_fields__}
        return type(self)(**{**rest, **{n: array[rows] for n, array in self._arrays().items()}})

    @classmethod
    def concatenate(cls, parts: Sequence[Self]) -> Self:
        """Return the rows of one part after another; fields that are no arrays are those of the first."""
        rest = {field.name: getattr(parts[0], field.name) for field in dataclasses.fields(cls)}
        arrays = {name: value for name, value in rest.items() if isinstance(value, np.ndarray)}
        joined = {n: np.concatenate([getattr(part, n) for part in parts]) for n in arrays}
        return cls(**{**rest, **joined})

    def _arrays(self) -> dict[str, NDArray[Any]]:
        values = vars(self)  # fields first; values that are computed once follow them
        names = self.__dataclass_fields__
        return {name: values[name] for name in names if isinstance(values[name], np.ndarray)}
