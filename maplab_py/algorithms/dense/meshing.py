"""The mesh of the grids of a map."""

from pathlib import Path

import numpy as np

from maplab_py.algorithms.dense import fusion, grid, options
from maplab_py.algorithms.dense.resources import DEPTH_MAPS, FrameImages, FrameResources
from maplab_py.array_types import F32, F64, I64, U8
from maplab_py.errors import EstimationError, UserError
from maplab_py.geometry import se3
from maplab_py.interop.mesh_files import write_mesh
from maplab_py.progress import SILENT, Progress
from maplab_py.report import Report
from maplab_py.sensors.projection import is_inside_image, project
from maplab_py.vimap import ResourceOwner, VIMap, resources_of


class MeshReport(Report):
    """A mesh that was written."""

    file: Path
    grids: int
    vertices: int
    triangles: int


def map_mesh(
    vi_map: VIMap,
    map_folder: Path,
    missions: I64 | None = None,
    min_weight: float = options.MESH_MIN_WEIGHT,
    most: float = np.inf,
) -> tuple[grid.Mesh, int]:
    """Return the surface of the grids of missions in G, and the number of grids.

    Args:
        missions: Rows of missions; None = all.
        min_weight: Weight from which voxels count as observed.
        most: Largest distance of a voxel beside a surface, as a share of the truncation.

    Raises:
        UserError: There is no grid.
        MapError: A file is missing or damaged.
        EstimationError: The grids have no surface of this weight.
    """
    grids = fusion.load_grids(vi_map, map_folder, missions)
    points, faces, count = [], [], 0
    for mission, stored in grids:
        mesh = stored.grid.mesh(min_weight, most)
        points.append(se3.transform(vi_map.T_G_M[mission], mesh.p))
        faces.append(mesh.faces + np.int32(count))
        count += len(mesh.p)
    if count == 0:
        raise EstimationError(
            f"the grid has no surface of weight {min_weight:g}: lower --dense_tsdf_mesh_min_weight"
        )
    return grid.Mesh(np.concatenate(points), np.concatenate(faces)), len(grids)


def write_map_mesh(
    vi_map: VIMap,
    map_folder: Path,
    file: Path,
    missions: I64 | None = None,
    min_weight: float = options.MESH_MIN_WEIGHT,
    *,
    with_colours: bool = False,
    overwrite: bool = False,
    progress: Progress = SILENT,
) -> MeshReport:
    """Write the surface of the grids of missions to a file; see `map_mesh` and `vertex_colours`.

    Raises:
        UserError: The file cannot be written, or its suffix is of no mesh format.
    """
    mesh, grids = map_mesh(vi_map, map_folder, missions, min_weight)
    colours = None
    if with_colours:
        colours = vertex_colours(vi_map, map_folder, mesh.p, missions, progress=progress)
    write_mesh(mesh.p, mesh.faces, file, colours, overwrite=overwrite)
    return MeshReport(file, grids, len(mesh.p), len(mesh.faces))


_VISIBLE_M, _VISIBLE_PART = 0.05, 0.03
"""A point is seen if its depth differs from the depth map's by no more than this, or this part of it."""
_UNSEEN = 128
_CHUNK = 500_000
"""Vertices that are projected at a time."""


def vertex_colours(
    vi_map: VIMap,
    map_folder: Path,
    p_G: F64,
    missions: I64 | None = None,
    *,
    progress: Progress = SILENT,
) -> U8:
    """Return the colours (N, 3) red, green, blue of points (N, 3) on surfaces.

    The mean over all frames with an image and a depth map in which the point is not hidden, weighted by
    1 / depth^2. Points that no image shows are grey.

    Args:
        p_G: Points in the global frame.
        missions: Rows of missions; None = all.

    Raises:
        UserError: No frame has both an image and a depth map.
        MapError: A file is missing or damaged.
    """
    images, resources = FrameImages(vi_map, map_folder), FrameResources(vi_map, map_folder)
    table = vi_map.resources
    chosen = resources_of(vi_map, DEPTH_MAPS, missions)
    chosen &= table.owner_kind == ResourceOwner.FRAME
    rows = [row for row in np.flatnonzero(chosen).tolist() if int(table.owner[row]) in images]
    if not rows:
        raise UserError(
            "no frame has an image and a depth map, which colours of a mesh come from: import_images"
        )
    total, weight = np.zeros((len(p_G), 3)), np.zeros(len(p_G))
    for done, row in enumerate(rows):
        progress.step(done, len(rows), "colours of the mesh")
        frame = int(table.owner[row])
        image = _as_rgb(np.asarray(images.image(frame)))
        depth = resources.depth(row)
        T_C_G = se3.inverse(resources.T_G_C(frame))
        for first in range(0, len(p_G), _CHUNK):
            part = slice(first, first + _CHUNK)
            p_C = se3.transform(T_C_G, p_G[part])
            seen, pixel = _seen(resources, frame, p_C, depth)
            w = 1.0 / p_C[seen, 2] ** 2
            total[part][seen] += w[:, None] * image[pixel[:, 1], pixel[:, 0]]
            weight[part][seen] += w
    mean = total / np.maximum(weight, 1e-12)[:, None]
    return np.where(weight[:, None] > 0.0, np.round(mean), _UNSEEN).astype(np.uint8)


def _seen(resources: FrameResources, frame: int, p_C: F64, depth: F32) -> tuple[I64, I64]:
    """Return which points (N, 3) the depth map does not hide, and their pixels."""
    camera = resources.camera(frame)
    uv, visible = project(camera, p_C)
    rows = np.flatnonzero(visible & (p_C[:, 2] > 0.0))
    rounded = np.round(uv[rows])  # may exceed the integers for points at the side of the camera
    inside = is_inside_image(camera, rounded)
    rows, pixel = rows[inside], rounded[inside].astype(np.int64)
    z, measured = p_C[rows, 2], depth[pixel[:, 1], pixel[:, 0]]
    near = np.abs(z - measured) <= np.maximum(_VISIBLE_M, _VISIBLE_PART * z)
    near &= measured > 0.0
    return rows[near], pixel[near]


def _as_rgb(image: U8) -> F64:
    if image.ndim == 2:
        image = np.repeat(image[:, :, None], 3, axis=2)
    return np.asarray(image[:, :, ::-1], dtype=np.float64)
