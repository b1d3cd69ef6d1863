"""A YAML mapping that is read key by key, with checks, and that tracks unread keys."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator, Mapping, Set
from typing import Any

import numpy as np

from maplab_py.array_types import F64
from maplab_py.errors import MapError
from maplab_py.geometry import se3
from maplab_py.input_files import LARGEST

_ROTATION_TOLERANCE = 1e-3
"""Largest entry of R^T R - I: hand-written calibrations with four digits pass."""
_SIMILAR = 0.8
"""Smallest ratio of common letters of a key and the one that it was probably meant to be."""


def similar_key(key: str, names: Iterable[Any]) -> str:
    """Return the name that a misspelt key probably stands for, "" if none is similar."""
    known = {_letters(name): str(name) for name in sorted(map(str, names))}
    matches = difflib.get_close_matches(_letters(key), known, n=1, cutoff=_SIMILAR)
    return known[matches[0]] if matches else ""


def _letters(key: Any) -> str:
    """Return a key without the signs and cases in which programs differ."""
    return "".join(character for character in str(key).lower() if character.isalnum())


class Entry:
    """A mapping with its location in the file. Errors are MapErrors that name location and key."""

    def __init__(self, values: Any, where: str) -> None:
        """Wrap a parsed YAML value; it must be a mapping."""
        if not isinstance(values, Mapping):
            raise MapError(f"{where}: key-value pairs are expected, not {_kind(values)}")
        self.where = where
        self._values = values
        self._used: set[str] = set()
        self._asked: set[str] = set()
        self._children: dict[str, Entry] = {}
        self._rows: dict[str, list[Entry]] = {}

    def __contains__(self, key: str) -> bool:
        self._asked.add(key)
        return self._values.get(key) is not None

    def __iter__(self) -> Iterator[Any]:
        """Yield all keys in the order of the file."""
        return iter(self._values)

    @property
    def content(self) -> Mapping[str, Any]:
        """All keys and values as parsed."""
        return self._values

    def raw(self, key: str) -> Any:
        """Return the value of a key as parsed and count the key as understood.

        Raises:
            MapError: The key is missing or empty.
        """
        self._used.add(key)
        if key not in self:
            similar = similar_key(key, self._values.keys() - self._used)
            hint = f"; is '{similar}' misspelt?" if similar else ""
            raise MapError(f"{self.where}: key '{key}' is missing{hint}")
        return self._values[key]

    def rest(self) -> dict[str, Any]:
        """Return the keys that were not read, including those of sub-entries."""
        rest = {key: value for key, value in self._values.items() if key not in self._used}
        for key, child in self._children.items():
            if child_rest := child.rest():
                rest[key] = child_rest
        return rest

    def unknown(self, ignored: Set[str] = frozenset()) -> Iterator[tuple[str, str]]:
        """Yield keys that were not read, and the absent key that each resembles or "".

        Args:
            ignored: Keys at any level that are left out.
        """
        absent = {key for key in self._asked if self._values.get(key) is None}
        for key in self._values:
            if key in self._children or key in self._rows:
                parts = (
                    [(str(key), self._children[key])]
                    if key in self._children
                    else [(f"{key}[{row}]", entry) for row, entry in enumerate(self._rows[key])]
                )
                for name, part in parts:
                    yield from ((f"{name}: {k}", hint) for k, hint in part.unknown(ignored))
            elif key not in self._used and key not in ignored:
                yield str(key), similar_key(str(key), absent)

    def entries(self, key: str) -> list[Entry]:
        """Return the mappings of the list under a key."""
        rows = [Entry(v, f"{self.where}: {key}[{row}]") for row, v in enumerate(self.items(key))]
        self._rows[key] = rows
        return rows

    def child(self, key: str) -> Entry:
        """Return the mapping under a key."""
        child = Entry(self.raw(key), f"{self.where}: {key}")
        self._children[key] = child
        return child

    def items(self, key: str) -> list[Any]:
        """Return the list under a key."""
        value = self.raw(key)
        if not isinstance(value, list):
            raise MapError(f"{self.where}: key '{key}' must be a list, not {_kind(value)}")
        return value

    def text(self, *keys: str, default: str = "") -> str:
        """Return the text of the first existing key."""
        result = default
        for key in reversed(keys):
            self._used.add(key)
            if key in self:
                value = self._values[key]
                if isinstance(value, (dict, list)):
                    raise MapError(f"{self.where}: key '{key}' must be text, not {_kind(value)}")
                result = str(value)
        return result

    def identifier(self, key: str = "id") -> str:
        """Return an id of 32 hexadecimal digits that is not all zero."""
        value = str(self.raw(key)).strip().lower()
        if len(value) != 32 or any(c not in "0123456789abcdef" for c in value):
            raise MapError(f"{self.where}: key '{key}': '{value}' is not 32 hexadecimal digits")
        if set(value) == {"0"}:
            raise MapError(f"{self.where}: key '{key}' is the invalid id (all zero)")
        return value

    def number(self, key: str, default: float | None = None, *, positive: bool = False) -> float:
        """Return a finite number."""
        if default is not None and key not in self:
            self._used.add(key)
            return default
        value = _as_float(self.raw(key))
        if not np.isfinite(value):
            raise MapError(f"{self.where}: key '{key}' must be a finite number below {LARGEST:g}")
        if positive and value <= 0.0:
            raise MapError(f"{self.where}: key '{key}' must be positive, not {value:g}")
        return value

    def integer(self, key: str, default: int | None = None) -> int:
        """Return a whole number."""
        if default is not None and key not in self:
            self._used.add(key)
            return default
        value = self.raw(key)
        if isinstance(value, float) and value.is_integer():
            value = int(value)
        if isinstance(value, bool) or not isinstance(value, int):
            raise MapError(f"{self.where}: key '{key}' must be a whole number, not {value!r}")
        return value

    def numbers(self, key: str) -> F64:
        """Return all finite numbers under a key (N,)."""
        return self._numbers(key).reshape(-1)

    def vector(self, key: str, count: int) -> F64:
        """Return `count` finite numbers: {rows, cols, data} or a plain list."""
        values = self._numbers(key)
        if values.size != count:
            raise MapError(f"{self.where}: key '{key}' needs {count} values, not {values.size}")
        return values.reshape(count)

    def matrix(self, key: str, rows: int, cols: int) -> F64:
        """Return a finite matrix: {rows, cols, data} or nested lists, data flat or nested."""
        values = self._numbers(key)
        if values.size != rows * cols or (values.ndim == 2 and values.shape != (rows, cols)):
            shape = " x ".join(str(n) for n in values.shape)
            raise MapError(f"{self.where}: key '{key}' must be {rows} x {cols}, not {shape}")
        return values.reshape(rows, cols)

    def rotation(self, key: str) -> F64:
        """Return a rotation matrix (3, 3)."""
        R = self.matrix(key, 3, 3)
        self._check_rotation(key, R)
        return R

    def pose(self, key: str) -> F64:
        """Return the pose (7,) of a homogeneous matrix."""
        m = self.matrix(key, 4, 4)
        if np.max(np.abs(m[3] - [0.0, 0.0, 0.0, 1.0])) > 1e-9:
            raise MapError(f"{self.where}: key '{key}': the last row must be 0 0 0 1")
        self._check_rotation(key, m[:3, :3])
        return se3.from_matrix(m)

    def _check_rotation(self, key: str, R: F64) -> None:
        error = float(np.max(np.abs(R.T @ R - np.eye(3))))
        if error > _ROTATION_TOLERANCE or np.linalg.det(R) < 0.0:
            raise MapError(f"{self.where}: key '{key}' is not a rotation matrix")

    def _numbers(self, key: str) -> F64:
        """Return the numbers under a key; with rows and cols in their shape."""
        value = self.raw(key)
        declared = None
        if isinstance(value, Mapping):
            entry = self.child(key)
            entry.text("dt")  # OpenCV's type of the entries
            declared = (entry.integer("rows"), entry.integer("cols"))
            value = entry.raw("data")
        try:
            numbers = np.array(_floats(value), dtype=np.float64)
        except ValueError as error:
            raise MapError(f"{self.where}: key '{key}': rows of unequal length") from error
        if not np.all(np.isfinite(numbers)):
            raise MapError(f"{self.where}: key '{key}' has entries that are not finite numbers")
        if declared is None:
            return numbers
        if min(declared) < 0 or numbers.size != declared[0] * declared[1]:
            raise MapError(
                f"{self.where}: key '{key}': {declared[0]} x {declared[1]} is declared, but data "
                f"has {numbers.size} values"
            )
        return numbers.reshape(declared)


def _floats(value: Any) -> Any:
    return [_floats(item) for item in value] if isinstance(value, list) else _as_float(value)


def _as_float(value: Any) -> float:
    """Return a number, or NaN if the value is not a number or its square overflows."""
    if isinstance(value, bool) or value is None:
        return float("nan")
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        return float("nan")
    return number if abs(number) <= LARGEST else float("nan")


def _kind(value: Any) -> str:
    if value is None:
        return "nothing"
    names: dict[type, str] = {dict: "key-value pairs", list: "a list", str: "text"}
    return names.get(type(value), repr(value))
