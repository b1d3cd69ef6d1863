"""Common parts of all figures: size, colours, writing to files."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from maplab_py.errors import UserError
from maplab_py.output_files import check_writable, write_bytes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SUFFIXES = (".png", ".svg", ".pdf")
_DPI = 150
_MAX_POINTS = 20_000


def new_figure(width_in: float = 8.0, height_in: float = 6.0) -> Figure:
    """Return an empty figure that belongs to no window system."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def mission_colour(row: int) -> Any:
    """Return the colour of a mission, the same in all figures."""
    from matplotlib import colormaps

    return colormaps["tab10"](row % 10)


def thinned(rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return at most some thousands of rows, evenly spaced, since a figure cannot show more."""
    return rows[:: max(1, -(-len(rows) // _MAX_POINTS))]


def label(axes: Axes, x: str, y: str, title: str = "") -> None:
    """Name the axes of a plot and give it a faint grid."""
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(visible=True, alpha=0.3)
    if title:
        axes.set_title(title)


def legend(axes: Axes, count: int) -> None:
    """Add a legend unless it would cover the plot."""
    if 0 < count <= 12:
        axes.legend(fontsize="small")


def check_plot_file(path: Path, *, overwrite: bool) -> None:
    """Check the path of a figure before any work is done.

    Raises:
        UserError: Its suffix is not one of `SUFFIXES`, or it exists and `overwrite` is not set.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise UserError(f"--plot_file={path}: the name must end in {', '.join(SUFFIXES)}")
    check_writable(path, overwrite=overwrite)


def write_figure(figure: Figure, path: Path) -> None:
    """Write a figure to a file; the same figure gives the same bytes.

    Raises:
        UserError: The file cannot be written.
    """
    import matplotlib as mpl

    metadata = {".png": {"Software": None}, ".svg": {"Date": None}, ".pdf": {"CreationDate": None}}
    suffix = path.suffix.lower()
    content = io.BytesIO()
    with mpl.rc_context({"svg.hashsalt": "maplab"}):  # ids in SVG files are random without it
        figure.savefig(content, format=suffix[1:], dpi=_DPI, metadata=metadata[suffix])
    write_bytes(path, [content.getvalue()], overwrite=True)
