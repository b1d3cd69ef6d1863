"""Figures of whole maps: trajectories from above, landmark statistics, shared landmarks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from maplab_py.errors import UserError
from maplab_py.plotting import figure as figures
from maplab_py.report import counted
from maplab_py.vimap import LandmarkQuality, VIMap, queries

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_QUALITY_COLOURS = {"UNKNOWN": "tab:gray", "BAD": "tab:red", "GOOD": "tab:green"}


def trajectories(
    vi_map: VIMap,
    missions: NDArray[np.int64] | None = None,
    *,
    landmarks: bool = True,
    p_G_truth: NDArray[np.float64] | None = None,
) -> Figure:
    """Draw the missions from above, x to the right, y upwards, in the global frame G.

    Args:
        missions: Rows of the missions to draw; None = all.
        landmarks: Draw the landmarks behind them (those not judged bad).
        p_G_truth: True positions (N, 3) in G, drawn as a black line.

    Raises:
        UserError: There are no vertices to draw.
    """
    chosen = np.flatnonzero(queries.mission_mask(vi_map, missions))
    mission, p_G_I = vi_map.vertices.mission, vi_map.T_G_I[:, 4:]
    if not np.isin(mission, chosen).any():
        raise UserError("the map has no vertices to draw")
    low, high = queries.limits_from_above(vi_map, chosen)
    if p_G_truth is not None:
        low = np.minimum(low, p_G_truth[:, :2].min(axis=0))
        high = np.maximum(high, p_G_truth[:, :2].max(axis=0))
    width, height = (high - low).tolist()
    figure = figures.new_figure(8.0, float(np.clip(8.0 * height / width, 2.5, 10.0)) + 0.7)
    axes = figure.subplots()
    if landmarks:
        is_good = vi_map.landmarks.quality != LandmarkQuality.BAD
        in_chosen = np.isin(vi_map.vertices.mission[vi_map.landmarks.vertex], chosen)
        p_G = vi_map.p_G[figures.thinned(np.flatnonzero(is_good & in_chosen))]
        axes.plot(*p_G[:, :2].T, ".", color="0.75", markersize=1.5, zorder=0)
    if p_G_truth is not None:
        axes.plot(*p_G_truth[:, :2].T, color="black", linewidth=0.8, label="truth")
    for row in chosen:
        x, y = p_G_I[mission == row, :2].T
        name = queries.mission_labels(vi_map)[row]
        axes.plot(x, y, color=figures.mission_colour(int(row)), linewidth=1.5, label=name)
        axes.plot(x[:1], y[:1], "o", color=figures.mission_colour(int(row)), markersize=5)
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal")
    unknown = np.count_nonzero(~vi_map.baseframes.is_known[vi_map.missions.baseframe[chosen]])
    note = f"; {unknown} of unknown base frame" if unknown else ""
    figures.label(
        axes, "x in G [m]", "y in G [m]", f"{counted(len(chosen), 'mission')} from above{note}"
    )
    figures.legend(axes, len(chosen))
    return figure


def landmark_histograms(vi_map: VIMap, missions: NDArray[np.int64] | None = None) -> Figure:
    """Draw observation counts, distances and quality of the landmarks.

    Raises:
        UserError: There are no landmarks.
    """
    chosen = queries.mission_mask(vi_map, missions)[
        vi_map.vertices.mission[vi_map.landmarks.vertex]
    ]
    if not chosen.any():
        raise UserError("the map has no landmarks to draw")
    counts = queries.observation_counts(vi_map)[chosen]
    distance_m = np.linalg.norm(vi_map.landmarks.p_I[chosen], axis=1)
    quality = vi_map.landmarks.quality[chosen]
    figure = figures.new_figure(11.0, 3.6)
    by_count, by_distance, by_quality = figure.subplots(1, 3)
    far_m = max(float(np.percentile(distance_m, 98.0)), 0.1)
    for kind in LandmarkQuality:
        of_kind = quality == kind
        style = {"color": _QUALITY_COLOURS[kind.name], "alpha": 0.6}
        most = int(np.percentile(counts, 99.0)) + 2
        by_count.hist(np.minimum(counts[of_kind], most), bins=np.arange(0, most + 2) - 0.5, **style)
        by_distance.hist(distance_m[of_kind], bins=40, range=(0.0, far_m), **style)
        by_quality.bar(kind.name.lower(), np.count_nonzero(of_kind), **style)
    figures.label(by_count, "observations of a landmark", "landmarks")
    figures.label(by_distance, "distance from the storing vertex [m]", "landmarks")
    figures.label(by_quality, "quality", "landmarks", f"{len(counts)} landmarks")
    return figure


def coobservability(vi_map: VIMap) -> Figure:
    """Draw the number of landmarks that each pair of missions shares.

    Raises:
        UserError: There are no missions.
    """
    if not len(vi_map.missions):
        raise UserError("the map has no missions to draw")
    counts = queries.coobservation_counts(vi_map)
    names = queries.mission_labels(vi_map)
    size_in = 3.5 + 0.45 * min(len(names), 40)
    figure = figures.new_figure(size_in + 1.0, size_in)
    axes = figure.subplots()
    shade = np.log10(np.maximum(counts, 0.5))
    image = axes.imshow(shade, cmap="viridis", vmin=np.log10(0.5))
    axes.set_xticks(range(len(names)), names, rotation=90, fontsize="small")
    axes.set_yticks(range(len(names)), names, fontsize="small")
    axes.set_title("landmarks that two missions share")
    if len(names) <= 20:
        low, high = image.get_clim()
        bright = shade > low + 0.6 * (high - low)
        for i, j in np.ndindex(*counts.shape):
            colour = "black" if bright[i, j] else "white"
            axes.text(
                j, i, str(counts[i, j]), ha="center", va="center", color=colour, fontsize="small"
            )
    bar = figure.colorbar(image, ax=axes, shrink=0.8)
    bar.set_label("landmarks, logarithm to base 10")
    return figure
