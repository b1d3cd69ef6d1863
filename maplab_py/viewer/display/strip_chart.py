"""Plots along a mission as one piece of HTML, with the values at the present position."""

from __future__ import annotations

import base64
from html import escape

import cv2
import numpy as np

from maplab_py.array_types import F64, I64, U8
from maplab_py.viewer.colours import AXES, hex_codes
from maplab_py.viewer.signals import Signal

_WIDTH, _HEIGHT = 1000, 100
"""Units of a plot's drawing, which is stretched to the room that there is."""
_ROW_PX = 26
_POINTS = 250
_SINGLE = ("#4c8dd6",)
_IMAGE_PX = 320


def plot_paths(signal: Signal, vertices: I64, progress: F64) -> tuple[str, ...]:
    """Return the curves of a signal, one SVG path per component, in a box of `_WIDTH` x `_HEIGHT`.

    Args:
        signal: What to plot.
        vertices: Rows (N,) of one mission, in order.
        progress: Where (N,) each of them is along the time line, in [0, 1].
    """
    values = signal.values[vertices]
    low, high = _range(values)
    y = _HEIGHT * (0.94 - 0.88 * (values - low) / (high - low))
    return tuple(_path(_WIDTH * progress, column) for column in y.T)


def _range(values: F64) -> tuple[float, float]:
    """Return between which values a plot extends; a hundredth at each end may lie outside."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return 0.0, 1.0
    low, high = np.percentile(finite, [1.0, 99.0]).tolist()
    if high - low < 1e-12:
        return low - 0.5, high + 0.5
    margin = 0.1 * (high - low)
    return low - margin, high + margin


def _path(x: F64, y: F64) -> str:
    """Return a polyline of at most twice `_POINTS` corners that keeps the extremes; NaN is a gap."""
    keep = np.arange(len(x))
    if len(x) > 2 * _POINTS:
        cell = np.minimum((x * (_POINTS / _WIDTH)).astype(np.int64), _POINTS - 1)
        order = np.lexsort((np.nan_to_num(y, nan=0.5 * _HEIGHT), cell))
        first = np.flatnonzero(np.diff(cell[order], prepend=-1))
        last = np.append(first[1:], len(order)) - 1
        keep = np.unique(np.concatenate([order[first], order[last]]))
    is_known = np.isfinite(y[keep])
    starts = is_known & ~np.append(False, is_known[:-1])
    return "".join(
        f"{'M' if start else 'L'}{px:.0f} {py:.0f}"
        for px, py, start, known in zip(
            x[keep].tolist(), np.clip(y[keep], -50, 150).tolist(), starts.tolist(), is_known.tolist(),
            strict=True,
        )
        if known
    )  # fmt: skip


def value_text(signal: Signal, vertex: int) -> str:
    """Return the values of a signal at a vertex, with its unit; a dash where they are unknown."""
    values = signal.values[vertex]
    if not np.isfinite(values).all():
        return "-"
    return " ".join(f"{value:.{signal.decimals}f}" for value in values.tolist()) + (
        f" {signal.unit}" if signal.unit else ""
    )


def image_tag(image: U8) -> str:
    """Return an image (H, W, 3) or (H, W) as a tag that carries its data."""
    scale = min(1.0, _IMAGE_PX / max(image.shape[1], 1))
    size = (max(1, round(scale * image.shape[1])), max(1, round(scale * image.shape[0])))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    if small.ndim == 3:
        small = np.ascontiguousarray(small[:, :, ::-1])
    _, data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 80])
    code = base64.b64encode(data.tobytes()).decode()
    return (
        f"<img src='data:image/jpeg;base64,{code}' alt='image of the vertex' "
        "style='height:100%;max-width:40%;object-fit:contain;border-radius:4px'>"
    )


def strip_chart(rows: list[tuple[str, tuple[str, ...], str]], at: float, image: str = "") -> str:
    """Return the plots below each other with a line at the present position, and an image beside.

    Args:
        rows: Title, curves and present values of each plot.
        at: The present position along the time line, in [0, 1].
        image: A tag that is shown beside the plots.
    """
    lines = "".join(_row(title, paths, value, at) for title, paths, value in rows)
    height = _ROW_PX * max(len(rows), 1)
    return (
        f"<div style='display:flex;gap:0.8em;padding:0.1em 0.9em 0.4em 0.9em;height:{height}px;"
        "font-size:0.74em;line-height:1.1'>"
        f"<div style='flex:1;min-width:0'>{lines}</div>{image}</div>"
    )


def _row(title: str, paths: tuple[str, ...], value: str, at: float) -> str:
    colours = _SINGLE if len(paths) == 1 else hex_codes(AXES)
    curves = "".join(
        f"<path d='{path}' fill='none' stroke='{colour}' stroke-width='1.3' "
        "vector-effect='non-scaling-stroke'/>"
        for path, colour in zip(paths, colours, strict=False)
    )
    x = _WIDTH * at
    return (
        f"<div style='display:flex;align-items:center;height:{_ROW_PX}px'>"
        f"<span style='width:11em;white-space:nowrap;opacity:0.65'>{escape(title)}</span>"
        f"<svg viewBox='0 0 {_WIDTH} {_HEIGHT}' preserveAspectRatio='none' "
        f"style='flex:1;min-width:0;height:{_ROW_PX - 4}px;background:rgba(128,128,128,0.09)'>"
        f"{curves}<path d='M{x:.1f} 0V{_HEIGHT}' stroke='currentColor' stroke-width='1' "
        "vector-effect='non-scaling-stroke'/></svg>"
        "<span style='width:15.5em;padding-left:0.7em;white-space:nowrap;"
        f"font-variant-numeric:tabular-nums'>{escape(value)}</span></div>"
    )
