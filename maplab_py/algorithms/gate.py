"""Gates of closures and landmarks: values compared with thresholds, and the flags that move them."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from maplab_py.array_types import F64, I64, Mask, NDArray

YES_NO = "yes or no"
"""Unit of gates whose value is 1 = yes or 0 = no."""
_DIGITS = 4
"""Significant digits of flags that are proposed."""


@dataclasses.dataclass(frozen=True, eq=False)
class Gate:
    """One gate for N closures or landmarks."""

    name: str
    verdict: str  # on rows that fail
    value: F64  # (N,), NaN where unknown, which passes
    threshold: F64  # (N,), infinite where a maximum is not checked
    applies: Mask  # (N,)
    flag_value: F64  # (N,) of the flag, with which the row just passes
    flag: str  # moves the threshold; empty = none does
    unit: str
    is_minimum: bool  # values below the threshold fail

    @classmethod
    def of(
        cls,
        name: str,
        value: NDArray[Any],
        threshold: float | F64,
        verdict: str,
        flag: str = "",
        unit: str = "",
        *,
        is_minimum: bool = False,
        applies: Mask | bool = True,
        flag_value: F64 | None = None,
    ) -> Gate:
        """Return a gate whose threshold and `applies` may be the same for all rows."""
        values = np.asarray(value, dtype=np.float64)
        limits = np.broadcast_to(np.asarray(threshold, dtype=np.float64), values.shape)
        applying = np.broadcast_to(np.asarray(applies, dtype=np.bool_), values.shape)
        passing = values if flag_value is None else flag_value
        return cls(name, verdict, values, limits, applying, passing, flag, unit, is_minimum)

    @classmethod
    def of_known(
        cls,
        name: str,
        value: NDArray[Any],
        threshold: float,
        verdict: str,
        flag: str = "",
        **rest: Any,
    ) -> Gate:
        """Return a gate that applies to the rows whose value is a number."""
        return cls.of(name, value, threshold, verdict, flag, applies=~np.isnan(value), **rest)

    @property
    def failed(self) -> Mask:
        """Rows (N,) whose value is beyond the threshold."""
        low, high = self.value < self.threshold, self.value > self.threshold
        return np.asarray(self.applies & (low if self.is_minimum else high))

    @property
    def shortfall(self) -> F64:
        """Distance (N,) to the threshold relative to it; 0 for rows that pass."""
        size = np.maximum(np.abs(self.threshold), 1e-9)
        distance = np.abs(self.value - self.threshold) / size
        return np.where(self.failed, distance, 0.0)

    def passing_value(self, row: int) -> float:
        """Return the flag's value with which a row passes, rounded so that it does."""
        value = float(self.flag_value[row])
        if not math.isfinite(value):
            return value
        scale = 10.0 ** (_DIGITS - 1 - math.floor(math.log10(max(abs(value), 1e-9))))
        return (math.floor if self.is_minimum else math.ceil)(value * scale) / scale

    def describe(self, row: int) -> tuple[str, str, str]:
        """Return value, wanted values and result (passed, failed, not checked) of a row as text."""
        value, threshold = self.value[row], self.threshold[row]
        result = "failed" if self.failed[row] else "passed"
        if self.unit == YES_NO:
            return "yes" if value else "no", "yes" if threshold else "no", result
        unit = f" {self.unit}" if self.unit else ""
        if np.isinf(threshold):
            return f"{value:.4g}{unit}", "any", "not checked"
        side = "at least" if self.is_minimum else "at most"
        return f"{value:.4g}{unit}", f"{side} {threshold:.4g}{unit}", result


def any_failed(gates: list[Gate]) -> Mask:
    """Return which rows (N,) fail any of the gates."""
    return np.asarray(np.any([gate.failed for gate in gates], axis=0))


def failures(gates: list[Gate]) -> tuple[I64, F64]:
    """Return how many gates each row (N,) fails, and its shortfalls summed over them."""
    failed = np.stack([gate.failed for gate in gates])
    shortfall = np.stack([gate.shortfall for gate in gates])
    return failed.sum(axis=0, dtype=np.int64), shortfall.sum(axis=0)
