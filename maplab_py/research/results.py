"""Results of the studies in units of the deviations of Schneider 2019, table 6.1."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from maplab_py.array_types import F64
from maplab_py.research.data_sets import Row

THESIS = {
    "focal length": (0.35, 1.0, "px"),
    "centre": (0.7, 1.0, "px"),
    "distortion": (5e-4, 1.0, ""),
    "gyroscope scale": (1e-3, 1.0, ""),
    "accelerometer scale": (2.5e-3, 1.0, ""),
    "gyroscope misalignment": (1e-3, 1.0, ""),
    "accelerometer misalignment": (5e-3, 1.0, ""),
    "accelerometer rotation": (0.15, float(np.rad2deg(1.0)), "deg"),
    "camera position": (3.0, 1e3, "mm"),
    "camera rotation": (0.07, float(np.rad2deg(1.0)), "deg"),
}
"""Deviation of table 6.1, factor to its unit, unit."""


def kind_of(name: str) -> str:
    """Return the row of the table that a parameter belongs to."""
    words = name.split()
    if words[0] == "camera" and words[1] in ("position", "rotation"):
        return " ".join(words[:2])
    if words[0] == "camera":
        return "focal length" if words[1] == "focal" else words[1]
    return f"{words[0]} {words[1] if words[1] == 'rotation' else words[2]}"


def levels(names: Sequence[str]) -> F64:
    """Return the deviation (k,) of every parameter in table 6.1, in the parameters' units."""
    return np.array([THESIS[kind_of(name)][0] / THESIS[kind_of(name)][1] for name in names])


def relative_rms(values: Sequence[float], names: Sequence[str]) -> float:
    """Return the root mean square of errors or deviations (k,) relative to table 6.1."""
    return float(np.sqrt(np.mean((np.array(values) / levels(names)) ** 2)))


def overall(row: Row) -> float:
    """Return the error of a calibration in units of the deviations of table 6.1."""
    return relative_rms(row["error"], row["names"])


class Results:
    """Results of one scenario, by method and data set."""

    def __init__(self, rows: list[Row], odometry: list[Row]) -> None:
        """Sort rows of `accuracy.measure` and of `odometry.measure_odometry`."""
        self.odometry_m = {(row["set"], row["method"]): row["vio_m"] for row in odometry}
        self.map_m = {row["method"]: row["map_m"] for row in rows if row["set"] < 0}
        self.by_method: dict[str, dict[int, Row]] = {}
        for row in rows:
            if row["set"] >= 0:
                self.by_method.setdefault(row["method"], {})[row["set"]] = row

    def pairs(self, method: str, other: str) -> tuple[list[Row], list[Row]]:
        """Return the rows of two methods for the data sets that both have."""
        first, second = self.by_method.get(method, {}), self.by_method.get(other, {})
        common = sorted(first.keys() & second.keys())
        return [first[k] for k in common], [second[k] for k in common]

    def spread_ratio(self, method: str, other: str) -> F64:
        """Return the ratio (k,) of the standard deviations of errors over the common data sets."""
        a, b = (
            np.std([row["error"] for row in rows], axis=0, ddof=1)
            for rows in self.pairs(method, other)
        )
        return np.asarray(a / b)
