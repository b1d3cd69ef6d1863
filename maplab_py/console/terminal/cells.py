"""Values as text: single values, and columns of a table whose numbers share their decimals."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

_SIGNIFICANT_DIGITS = 4
_LEAST_SIGNIFICANT_DIGITS = 3
_MORE_DECIMALS = 2
_MAX_DECIMALS = 6
_FIXED_POINT_RANGE = (1e-4, 1e9)
_ROUNDING_NOISE = 1e-12
"""Smaller numbers are shown as zeros."""


def format_cell(value: Any) -> str:
    """Format one value; numbers have four to six significant digits."""
    if isinstance(value, (bool, np.bool_)):
        return "yes" if value else "no"
    if isinstance(value, (float, np.floating)):
        return _format_float(float(value))
    if isinstance(value, (int, np.integer)) and not isinstance(value, Enum):
        return f"{int(value)}"
    if isinstance(value, Enum):
        return value.name.lower()
    if isinstance(value, np.ndarray):
        return _format_array(value)
    if isinstance(value, (list, tuple, set, frozenset)):
        return ", ".join(format_cell(item) for item in value) or "none"
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {format_cell(item)}" for key, item in value.items()) or "none"
    return "-" if value is None else str(value)


def format_column(values: Sequence[Any]) -> list[str]:
    """Format the cells of a column; its numbers with fractions have the same number of decimals.

    The largest number has at least four significant digits, and up to two decimals more if the
    smallest needs them. Where the largest would be too long or too small all numbers have exponents.
    """
    numbers = [abs(float(v)) for v in values if isinstance(v, (float, np.floating))]
    sizes = [number for number in numbers if number > 0 and math.isfinite(number)]
    if not sizes or max(sizes) < _ROUNDING_NOISE:
        return [_format_plain(0.0 if _is_number(value) else value) for value in values]
    if not _is_fixed_point(sizes):
        return [f"{value:.3e}" if _is_number(value) else _format_plain(value) for value in values]
    largest = max(_SIGNIFICANT_DIGITS - 1 - math.floor(math.log10(max(sizes))), 0)
    smallest = _LEAST_SIGNIFICANT_DIGITS - 1 - math.floor(math.log10(min(sizes)))
    decimals = min(max(largest, min(smallest, largest + _MORE_DECIMALS)), _MAX_DECIMALS)
    return [
        _format_fixed(float(value), decimals) if _is_number(value) else _format_plain(value)
        for value in values
    ]


def _format_fixed(value: float, decimals: int) -> str:
    """Format a number with decimals; what they round to zero has no sign."""
    text = f"{value:.{decimals}f}"
    return text if float(text) else text.removeprefix("-")


def _is_number(value: Any) -> bool:
    """Tell whether a cell is a finite number with a fraction."""
    return isinstance(value, (float, np.floating)) and math.isfinite(value)


def _is_fixed_point(sizes: list[float]) -> bool:
    low, high = _FIXED_POINT_RANGE
    return max(sizes) >= low and max(sizes) < high


def _format_plain(value: Any) -> str:
    if isinstance(value, Path):
        return str(value)
    is_empty = isinstance(value, (str, list, tuple, Mapping)) and len(value) == 0
    return "" if is_empty else format_cell(value)


def _format_float(value: float) -> str:
    if not np.isfinite(value):
        return "-" if np.isnan(value) else str(value)
    if abs(value) < _ROUNDING_NOISE:
        value = 0.0
    if value == 0 or 1e-4 <= abs(value) < 1e6:
        digits = 4 if abs(value) < 100 else 2
        return f"{value:.{digits}f}" if abs(value) >= 1e-2 or value == 0 else f"{value:.6f}"
    return f"{value:.4g}"


def _format_array(value: np.ndarray[Any, Any]) -> str:
    if value.size > 16:
        shape = " x ".join(str(n) for n in value.shape)
        return f"array of {shape}"
    if value.ndim <= 1:
        return " ".join(format_cell(item) for item in np.atleast_1d(value))
    return "; ".join(_format_array(row) for row in value)
