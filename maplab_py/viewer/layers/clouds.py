"""Dense clouds and meshes as layers."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.array_types import F64, U8
from maplab_py.viewer import colours
from maplab_py.viewer.drawing import (
    MAX_POINTS,
    NO_POSITION,
    Drawing,
    make_points,
    omission_notes,
    spread_rows,
)
from maplab_py.viewer.scene import WHOLE_MAP, Layer, LegendEntry, Mesh, Part


@dataclasses.dataclass(frozen=True, eq=False)
class Cloud:
    """A dense cloud or a mesh in G."""

    title: str
    p_G: F64  # (N, 3) [m]
    colours: U8 | None = None  # (N, 3)
    intensity: F64 | None = None  # (N,)
    faces: NDArray[np.int32] | None = None  # (F, 3)
    mission_id: str = WHOLE_MAP
    vertex: int = -1  # row at which it was recorded; -1 = of the whole session
    legend: tuple[LegendEntry, ...] = ()  # what the colours mean


ColourRanges = dict[str, tuple[float, float]]
"""First and last value of the ramp, by what the ramp is of: height or intensity."""


def cloud_layer(drawing: Drawing, clouds: tuple[Cloud, ...], number: int = 0) -> Layer:
    """Return one layer of clouds of the same title, with no more points than the options allow."""
    total = sum(len(cloud.p_G) for cloud in clouds)
    parts: dict[str, Part] = {}
    thinned = 0
    ranges = colour_ranges(clouds)
    for mission_id in dict.fromkeys(cloud.mission_id for cloud in clouds):
        mission_clouds = [cloud for cloud in clouds if cloud.mission_id == mission_id]
        p = np.concatenate([cloud.p_G for cloud in mission_clouds]) - drawing.origin_G
        colour = np.concatenate([cloud_colours(cloud, ranges) for cloud in mission_clouds])
        limit = max(1, drawing.options.max_points * len(p) // max(total, 1))
        finite = np.flatnonzero(np.isfinite(p).all(axis=1))
        rows = finite[spread_rows(p[finite], limit)]
        thinned += len(finite) - len(rows)
        # the width of a square that each point has for itself on the surface of the map's ball
        size = 0.9 * drawing.unit_m / np.sqrt(max(len(rows), 1_000))
        parts[mission_id] = make_points(p[rows], colour[rows], rows, size)
    title = clouds[0].title if clouds else "Dense cloud"
    drawn = sum(len(part) for part in parts.values())
    losses = (total - drawn - thinned, NO_POSITION), (thinned, MAX_POINTS)
    notes = omission_notes(title, drawn, *losses)
    stored = dict.fromkeys(entry for cloud in clouds for entry in cloud.legend)
    legend = (*stored, *range_legend(title, ranges))
    return Layer(f"cloud_{number}", title, parts, total, legend=legend, notes=notes)


def mesh_layer(drawing: Drawing, cloud: Cloud, number: int) -> Layer:
    """Return a triangle mesh as a layer, in its own colours if it has any."""
    faces = np.zeros((0, 3), dtype=np.int32) if cloud.faces is None else cloud.faces
    p = np.ascontiguousarray(cloud.p_G - drawing.origin_G, dtype=np.float32)
    colour = cloud.colours
    if colour is None:
        colour = np.median(cloud_colours(cloud), axis=0).astype(np.uint8)
    parts = {cloud.mission_id: Mesh(p, faces, colour)}
    swatch = () if colour.ndim == 2 else (LegendEntry(cloud.title, (colours.to_hex(colour),)),)
    return Layer(f"mesh_{number}", cloud.title, parts, len(faces), legend=cloud.legend or swatch)


def cloud_colours(cloud: Cloud, ranges: ColourRanges | None = None) -> U8:
    """Return the colours (N, 3) stored with the cloud; else by intensity, else by height.

    Args:
        ranges: Values of the first and the last colour; the cloud's own when not given.
    """
    if cloud.colours is not None:
        return cloud.colours
    what, values = _coloured_by(cloud)
    low, high = (ranges or colour_ranges((cloud,)))[what]
    return colours.ramp((values - low) / max(high - low, 1e-12), colours.SEQUENTIAL)


def colour_ranges(clouds: tuple[Cloud, ...]) -> ColourRanges:
    """Return the usual range of what colours those clouds that have no colours."""
    values: dict[str, list[F64]] = {}
    for cloud in clouds:
        if cloud.colours is None:
            what, number = _coloured_by(cloud)
            values.setdefault(what, []).append(number)
    return {what: colours.normalised(np.concatenate(all_))[1:] for what, all_ in values.items()}


def range_legend(title: str, ranges: ColourRanges) -> tuple[LegendEntry, ...]:
    """Return the ramps of clouds that are coloured by a value."""
    units, stops = {"height": " m", "intensity": ""}, colours.SEQUENTIAL
    return tuple(
        LegendEntry.ramp(f"{title}: {what}", stops, *(f"{end:.4g}{units[what]}" for end in ends))
        for what, ends in ranges.items()
    )


def _coloured_by(cloud: Cloud) -> tuple[str, F64]:
    """Return what colours a cloud without colours, and its values (N,)."""
    if cloud.intensity is None:
        return "height", np.asarray(cloud.p_G[:, 2], dtype=np.float64)
    return "intensity", np.asarray(cloud.intensity, dtype=np.float64)


def layers_of_clouds(drawing: Drawing, clouds: tuple[Cloud, ...]) -> list[Layer]:
    """Return one layer per title; meshes have one each."""
    layers = []
    plain = [cloud for cloud in clouds if cloud.faces is None]
    for number, title in enumerate(dict.fromkeys(cloud.title for cloud in plain)):
        titled = tuple(cloud for cloud in plain if cloud.title == title)
        layers.append(cloud_layer(drawing, titled, number))
    meshes = [cloud for cloud in clouds if cloud.faces is not None]
    return layers + [mesh_layer(drawing, mesh, number) for number, mesh in enumerate(meshes)]
