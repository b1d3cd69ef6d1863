"""Figures of Schneider 2019: tables 6.1 to 6.3 and 7.2 to 7.5, and errors in units of its deviations.

Deviations are root mean squares over the axes of a parameter; the columns of its tables are spread over
lines in another order than the names, which table 6.2 settles.
"""

from collections.abc import Sequence

import numpy as np

from maplab_py.array_types import F64

Figures = dict[str, Sequence[float | None]]

TABLE_61: Figures = {
    "focal length": (0.29, 0.14, 0.34),
    "centre": (0.39, 0.20, 0.53),
    "distortion": (3e-4, 3e-4, 7e-4),
    "gyroscope scale": (7.7e-4, 3.9e-4, 1.2e-3),
    "accelerometer scale": (1.7e-3, 9.6e-4, 1.6e-3),
    "gyroscope misalignment": (7.8e-4, 4.4e-4, 8.6e-4),
    "accelerometer misalignment": (3.3e-3, 1.6e-3, 1.7e-3),
    "accelerometer rotation": (0.14, 0.056, 0.060),
    "camera position": (2.7, 1.2, 2.9),
    "camera rotation": (0.062, 0.019, 0.047),
}
"""Deviations over 15 data sets: informative segments, all of them, Maye et al."""
TABLE_62: Figures = {
    "centre": (0.25, 0.44, 0.20),
    "gyroscope misalignment": (5.2e-4, 9.0e-4, 4.4e-4),
}
"""Deviations: several groups, a single group, all segments."""
TABLE_63: Figures = {
    "segments": (8.7, 9.0, 38.0),
    "run time [s]": (31.2, 395.9, 178.5),
}
"""Informative segments, Maye et al., all segments."""
TABLE_72: Figures = {
    "AR/VR: office room": (23.8, 117.3, 0.20, 20.3),
    "AR/VR: class room": (37.4, 122.9, 0.29, 29.6),
    "navigation: parking garage": (168.4, 305.0, 0.57, 20.5),
    "navigation: office building": (164.8, 295.6, 0.55, 23.1),
}
"""Mean length [m], duration [s], speed [m/s], turn rate [deg/s]."""
TABLE_73: Figures = {
    "AR/VR: office room": (13.07, 1.50, 1.62, 1.76, 1.79, 3.99, 1.86),
    "AR/VR: class room": (13.09, 1.41, 1.79, 1.28, 1.42, 5.45, 2.44),
    "navigation: parking garage": (13.09, 4.66, 1.65, 2.14, 1.59, 4.97, 3.04),
    "navigation: office building": (13.13, 1.86, 1.68, 1.39, 1.26, 2.32, 2.56),
}
"""Error of odometry [cm]: nominal, all segments, E-, D-, A-optimality, random, joint filter."""
TABLE_74: Figures = {
    "focal length": (0.64, 0.25, None),
    "centre": (0.95, 0.46, None),
    "distortion": (9e-4, 8e-4, None),
    "gyroscope scale": (2.9e-3, 3.1e-4, 3.1e-3),
    "accelerometer scale": (1.2e-2, 2.1e-3, 5.2e-3),
    "gyroscope misalignment": (1.8e-3, 7.8e-4, 1.4e-3),
    "accelerometer misalignment": (1.1e-2, 1.9e-3, 5.2e-3),
    "accelerometer rotation": (0.43, 0.010, 0.15),
    "camera position": (12.8, 3.0, 4.8),
    "camera rotation": (0.13, 0.071, 0.069),
}
"""Deviations over the sessions: 8 segments, all of them, joint filter."""
TABLE_75: Figures = {
    "odometry, an image": (0.003, None, 0.003),
    "selection, a segment": (0.156, None, None),
    "calibration, a session": (12.05, 27.03, None),
}
"""Run times [s]: 8 segments, all of them, joint filter."""

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
