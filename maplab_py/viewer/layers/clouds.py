"""Dense clouds and meshes as layers."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.array_types import F64, U8
from maplab_py.viewer import colours
from maplab_py.viewer.drawing import Drawing, make_points
from maplab_py.viewer.omissions import MAX_POINTS, NO_POSITION, omission_notes
from maplab_py.viewer.scene import WHOLE_MAP, Layer, LegendEntry, Mesh, Part
from maplab_py.viewer.subsampling import spread_rows


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


def cloud_layer(drawing: Drawing, clouds: tuple[Cloud, ...], number: int = 0) -> Layer:
    """Return one layer of clouds of the same title, with no more points than the options allow."""
    total = sum(len(cloud.p_G) for cloud in clouds)
    parts: dict[str, Part] = {}
    thinned = 0
    for mission_id in dict.fromkeys(cloud.mission_id for cloud in clouds):
        mission_clouds = [cloud for cloud in clouds if cloud.mission_id == mission_id]
        p = np.concatenate([cloud.p_G for cloud in mission_clouds]) - drawing.origin_G
        colour = np.concatenate([cloud_colours(cloud) for cloud in mission_clouds])
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
    legend = clouds[0].legend if clouds else ()
    return Layer(f"cloud_{number}", title, parts, total, legend=legend, notes=notes)


def mesh_layer(drawing: Drawing, cloud: Cloud, number: int) -> Layer:
    """Return a triangle mesh as a layer, in its own colours if it has any."""
    faces = np.zeros((0, 3), dtype=np.int32) if cloud.faces is None else cloud.faces
    p = np.ascontiguousarray(cloud.p_G - drawing.origin_G, dtype=np.float32)
    colour = cloud.colours
    if colour is None:
        colour = np.median(cloud_colours(cloud), axis=0).astype(np.uint8)
    parts: dict[str, Part] = {cloud.mission_id: Mesh(p, faces, colour)}
    return Layer(f"mesh_{number}", cloud.title, parts, len(faces), legend=cloud.legend)


def cloud_colours(cloud: Cloud) -> U8:
    """Return the colours (N, 3) stored with the cloud; else by intensity, else by height."""
    if cloud.colours is not None:
        return cloud.colours
    values = cloud.p_G[:, 2] if cloud.intensity is None else cloud.intensity
    part, _, _ = colours.normalised(np.asarray(values, dtype=np.float64))
    return colours.ramp(part, colours.SEQUENTIAL)


def layers_of_clouds(drawing: Drawing, clouds: tuple[Cloud, ...]) -> list[Layer]:
    """Return one layer per title; meshes have one each."""
    layers = []
    plain = [cloud for cloud in clouds if cloud.faces is None]
    for number, title in enumerate(dict.fromkeys(cloud.title for cloud in plain)):
        titled = tuple(cloud for cloud in plain if cloud.title == title)
        layers.append(cloud_layer(drawing, titled, number))
    meshes = [cloud for cloud in clouds if cloud.faces is not None]
    return layers + [mesh_layer(drawing, mesh, number) for number, mesh in enumerate(meshes)]
