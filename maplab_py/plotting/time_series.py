"""Figures over time: errors against ground truth, and the inertial states of a mission."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.evaluation import pose_errors
from maplab_py.algorithms.evaluation.options import TrajectoryEvaluationOptions
from maplab_py.algorithms.evaluation.trajectory_evaluation import match
from maplab_py.errors import EstimationError, UserError
from maplab_py.geometry import se3
from maplab_py.interop.trajectories import Trajectory
from maplab_py.plotting.figure import label, legend, mission_colour, new_figure
from maplab_py.vimap import VIMap, mission_mask
from maplab_py.vimap.queries import mission_labels

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLOURS = ("tab:red", "tab:green", "tab:blue")


def errors_over_time(
    vi_map: VIMap,
    ground_truth: Trajectory,
    options: TrajectoryEvaluationOptions,
    missions: NDArray[np.int64] | None = None,
) -> tuple[Figure, float]:
    """Draw the position and attitude errors of the vertices; also return the RMSE of position [m].

    All chosen missions are aligned with the ground truth jointly, as in `evaluate_trajectory`.

    Raises:
        EstimationError: Fewer than three vertices have ground truth.
    """
    rows, T_R_B = _with_truth(vi_map, ground_truth, options, missions)
    T_R_I, _ = pose_errors.align(T_R_B, vi_map.T_G_I[rows], options.alignment)
    error_m, error_deg = pose_errors.absolute_errors(T_R_B, T_R_I)
    if not ground_truth.has_orientation:
        error_deg = np.full(len(error_deg), np.nan)
    offset_m = T_R_I[:, 4:] - T_R_B[:, 4:]
    time_ns, mission = vi_map.vertices.timestamp_ns[rows], vi_map.vertices.mission[rows]
    figure = new_figure(9.0, 7.0)
    axes = figure.subplots(3, 1, sharex=True)
    for row in np.unique(mission):
        of = mission == row
        time_s = (time_ns[of] - time_ns.min()) * 1e-9
        name, colour = mission_labels(vi_map)[row], mission_colour(row)
        axes[0].plot(time_s, error_m[of], color=colour, label=name)
        axes[2].plot(time_s, error_deg[of], color=colour)
        for axis, style in enumerate(("-", "--", ":")):
            axes[1].plot(time_s, offset_m[of, axis], style, color=colour, linewidth=0.9)
    rmse_m = float(np.sqrt(np.mean(error_m**2)))
    label(axes[0], "", "position error [m]", f"RMSE {rmse_m:.4f} m, alignment {options.alignment}")
    label(axes[1], "", "x –, y - -, z ·· [m]")
    label(axes[2], "time [s]", "attitude error [deg]")
    legend(axes[0], len(np.unique(mission)))
    return figure, rmse_m


def truth_in_global_frame(
    vi_map: VIMap, ground_truth: Trajectory, missions: NDArray[np.int64] | None = None
) -> NDArray[np.float64]:
    """Return the positions (N, 3) of a ground truth, aligned with the vertices rigidly.

    Raises:
        EstimationError: Fewer than three vertices have ground truth.
    """
    rows, T_R_B = _with_truth(vi_map, ground_truth, TrajectoryEvaluationOptions(), missions)
    T_G_I = vi_map.T_G_I[rows]
    T_R_I, _ = pose_errors.align(T_R_B, T_G_I, "se3")
    T_G_R = se3.compose(T_G_I[:1], se3.inverse(T_R_I[:1]))
    positions: NDArray[np.float64] = se3.transform(T_G_R, ground_truth.T_R_B[:, 4:])
    return positions


def _with_truth(
    vi_map: VIMap,
    ground_truth: Trajectory,
    options: TrajectoryEvaluationOptions,
    missions: NDArray[np.int64] | None,
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the vertices (N,) of some missions that have ground truth, and it (N, 7)."""
    rows = np.flatnonzero(mission_mask(vi_map, missions)[vi_map.vertices.mission])
    T_R_B, matched = match(ground_truth, vi_map.vertices.timestamp_ns[rows], options)
    if np.count_nonzero(matched) < 3:
        raise EstimationError(
            f"fewer than three vertices have ground truth in {ground_truth.source}"
        )
    return rows[matched], T_R_B[matched]


def inertial_states(vi_map: VIMap, mission: int) -> Figure:
    """Draw position, velocity and the two biases of a mission's vertices over time.

    Raises:
        UserError: The mission has no vertices.
    """
    rows = np.flatnonzero(vi_map.vertices.mission == mission)
    if not len(rows):
        raise UserError(f"mission {mission_labels(vi_map)[mission]} has no vertices to draw")
    vertices = vi_map.vertices
    time_s = (vertices.timestamp_ns[rows] - vertices.timestamp_ns[rows[0]]) * 1e-9
    panels = (
        ("position in M [m]", vertices.T_M_I[rows, 4:]),
        ("velocity in M [m/s]", vertices.v_M[rows]),
        ("gyroscope bias [mrad/s]", 1e3 * vertices.gyro_bias[rows]),
        ("accelerometer bias [m/s²]", vertices.accel_bias[rows]),
    )
    figure = new_figure(9.0, 8.5)
    axes = figure.subplots(len(panels), 1, sharex=True)
    for panel, (name, values) in zip(axes, panels, strict=True):
        for axis, colour in enumerate(_COLOURS):
            panel.plot(time_s, values[:, axis], color=colour, label="xyz"[axis])
        label(panel, "", name)
    axes[0].set_title(f"mission {mission_labels(vi_map)[mission]}")
    axes[-1].set_xlabel("time since the first vertex [s]")
    legend(axes[0], 3)
    return figure
