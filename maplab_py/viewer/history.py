"""States of a map along its undo history: their errors as curves, and what an exported page draws of each."""

import dataclasses
import weakref
from collections.abc import Sequence
from html import escape

import numpy as np

from maplab_py.algorithms.landmarks.sightings import residuals
from maplab_py.algorithms.loop_closure import closure_record, closure_table, reports
from maplab_py.errors import MapError, UserError
from maplab_py.geometry import se3
from maplab_py.interop.trajectories import Trajectory
from maplab_py.viewer import colours, scene
from maplab_py.viewer.drawing import Drawing
from maplab_py.viewer.layers.landmarks import landmarks
from maplab_py.viewer.layers.paths import trajectories
from maplab_py.viewer.layers.references import position_errors
from maplab_py.vimap import VIMap

MAX_STATES = 40
"""Of more states an exported page has the last ones."""
_MAX_OBSERVATIONS = 100_000
"""Of more observations every n-th counts: the median does not need all."""
_MAX_POINTS = 200_000
"""Landmarks of all states of an exported page together."""


@dataclasses.dataclass(frozen=True, eq=False)
class State:
    """A value that the map had, has, or would have after redo."""

    command: str  # that made it; empty = the first that is known
    vi_map: VIMap


@dataclasses.dataclass(frozen=True)
class Curve:
    """A number of each state; NaN where it is unknown."""

    title: str
    unit: str
    decimals: int
    values: tuple[float, ...]


def error_curves(states: Sequence[State], truth: Trajectory | None = None) -> tuple[Curve, ...]:
    """Return the errors of each state that can be computed: of pixels, at closures, and to ground truth.

    The gap is measured at the same closures in all states: those that the last state with any accepts.
    """
    closures = _accepted_closures(states)
    curves = [
        Curve("reprojection, median", "px", 3, tuple(_reprojection_px(s.vi_map) for s in states)),
        Curve("gap at closures, median", "m", 3, tuple(_gap_m(s.vi_map, closures) for s in states)),
    ]
    if truth is not None:
        errors = tuple(_error_m(s.vi_map, truth) for s in states)
        curves.append(Curve("error to the truth, RMSE", "m", 3, errors))
    return tuple(curve for curve in curves if np.isfinite(curve.values).any())


_REPROJECTION_PX: weakref.WeakKeyDictionary[VIMap, float] = weakref.WeakKeyDictionary()


def _reprojection_px(vi_map: VIMap) -> float:
    """Return the median reprojection error of good landmarks in front of their cameras, NaN without."""
    if vi_map not in _REPROJECTION_PX:
        rows = vi_map.observations
        rows = rows[:: max(1, -(-len(rows) // _MAX_OBSERVATIONS))]
        landmark = vi_map.keypoints.landmark[rows]
        is_good = vi_map.landmarks.quality[landmark] != 1
        rows, landmark = rows[is_good], landmark[is_good]
        try:
            error_px = residuals(vi_map, rows, vi_map.p_G[landmark]).error_px
        except MapError:
            error_px = np.zeros(0)
        _REPROJECTION_PX[vi_map] = _median(error_px)
    return _REPROJECTION_PX[vi_map]


def _accepted_closures(states: Sequence[State]) -> closure_record.ClosureRecord:
    for state in reversed(states):
        try:
            closures = closure_record.read_record(state.vi_map).closures
        except MapError:
            continue
        accepted = closures.take(
            closures.verdict == closure_table.VERDICTS.index(reports.Verdict.ACCEPTED)
        )
        if len(accepted):
            return accepted
    return closure_record.ClosureRecord.empty()


def _gap_m(vi_map: VIMap, closures: closure_record.ClosureRecord) -> float:
    """Return the median distance of the poses of a map from closures that it need not remember."""
    a, b = (vi_map.vertex_index.rows(ids) for ids in (closures.query, closures.place))
    kept = (a >= 0) & (b >= 0)
    T_A_B = se3.relative(vi_map.T_G_I[a[kept]], vi_map.T_G_I[b[kept]])
    return _median(np.linalg.norm(T_A_B[:, 4:] - closures.T_A_B[kept, 4:], axis=1))


def _error_m(vi_map: VIMap, truth: Trajectory) -> float:
    try:
        error_m = position_errors(vi_map.vertices.timestamp_ns, vi_map.T_G_I[:, 4:], truth)
    except UserError:
        return np.nan
    return float(np.sqrt(np.nanmean(error_m**2)))


def _median(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else np.nan


def state_layers(drawing: Drawing, state: State, states: int) -> tuple[scene.Layer, ...]:
    """Return paths and landmarks of one of several states, where the drawing has its origin."""
    limit = min(drawing.options.max_points, max(1, _MAX_POINTS // states))
    options = dataclasses.replace(drawing.options, max_points=limit)
    other = dataclasses.replace(drawing.of_state(state.vi_map), options=options)
    return trajectories(other), landmarks(other)[0]


def state_facts(curves: Sequence[Curve], shown: int) -> list[str]:
    """Return a line with each error of a state that is known."""
    return [
        f"{curve.title}: {curve.values[shown]:.{curve.decimals}f} {curve.unit}"
        for curve in curves
        if np.isfinite(curve.values[shown])
    ]


_WIDTH, _HEIGHT = 240.0, 26.0
_COLOURS = colours.hex_codes(colours.MISSIONS)


def history_chart(states: Sequence[State], curves: Sequence[Curve], shown: int) -> str:
    """Return HTML: the command of a state, its errors, and the curves of all with a line at it."""
    name = escape(states[shown].command or "before the first command")
    title = f"{shown + 1} of {len(states)}: {name}"
    lines = [f"<div style='font-weight:600;overflow-wrap:anywhere'>{title}</div>"]
    for colour, curve in zip(_COLOURS, curves, strict=False):
        value = curve.values[shown]
        text = f"{value:.{curve.decimals}f} {curve.unit}" if np.isfinite(value) else "-"
        lines.append(
            "<div style='display:flex;justify-content:space-between;margin-top:0.35em'>"
            f"<span>{escape(curve.title)}</span>"
            f"<span style='font-variant-numeric:tabular-nums'>{text}</span></div>"
            + _plot(curve.values, colour, shown)
        )
    style = "font-size:0.78em;line-height:1.4;padding:0.1em 0.9em 0.5em 0.9em"
    return f"<div style='{style}'>{''.join(lines)}</div>"


def _plot(values: Sequence[float], colour: str, shown: int) -> str:
    """Return a curve from zero to its largest value, with a dot at each state."""
    y_values = np.array(values)
    largest = max(float(np.nanmax(y_values)), 1e-12)
    x = _WIDTH * (0.03 + 0.94 * np.arange(len(y_values)) / max(len(y_values) - 1, 1))
    y = _HEIGHT * (0.92 - 0.84 * y_values / largest)
    places = [(px, py) for px, py in zip(x.tolist(), y.tolist(), strict=True) if np.isfinite(py)]
    path = " ".join(f"{px:.1f},{py:.1f}" for px, py in places)
    dots = "".join(f"<circle cx='{px:.1f}' cy='{py:.1f}' r='2.6'/>" for px, py in places)
    return (
        f"<svg viewBox='0 0 {_WIDTH:.0f} {_HEIGHT:.0f}' style='display:block;width:100%;"
        "background:rgba(128,128,128,0.1);border-radius:3px'>"
        f"<path d='M{x[shown]:.1f} 0V{_HEIGHT:.0f}' stroke='currentColor' stroke-opacity='0.5'/>"
        f"<polyline points='{path}' fill='none' stroke='{colour}' stroke-width='1.6'/>"
        f"<g fill='{colour}'>{dots}</g></svg>"
    )
