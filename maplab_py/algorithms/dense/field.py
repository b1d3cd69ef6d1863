"""Euclidean signed distance fields: every observed voxel's distance from the nearest surface."""

import dataclasses
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from maplab_py.algorithms.dense import depth_inputs
from maplab_py.algorithms.dense.grid import (
    BLOCK_SHAPE,
    GridContent,
    GridFormat,
    TsdfGrid,
    encode_arrays,
    rows_in,
)
from maplab_py.algorithms.dense.grid_kernels import BLOCK_SIDE
from maplab_py.algorithms.dense.options import MESH_MIN_WEIGHT, DistanceOptions, FusionOptions
from maplab_py.algorithms.dense.resources import chosen_missions
from maplab_py.algorithms.dense.triangle_tree import TriangleTree
from maplab_py.array_types import F32, F64, I32, I64, Mask
from maplab_py.errors import EstimationError, UserError
from maplab_py.geometry import se3
from maplab_py.interop.ply import PlyCloud, write_ply
from maplab_py.memory import require_memory
from maplab_py.progress import SILENT, Progress
from maplab_py.report import Report, counted
from maplab_py.storage.resources.new import NewResources
from maplab_py.storage.resources.store import ResourceStore
from maplab_py.storage.resources.types import resource_type
from maplab_py.vimap import ResourceOwner, VIMap, resources_of, to_hex, without_resources

_BLOCKS_AT_A_TIME = 128
_BYTES_PER_BLOCK = 4 * BLOCK_SIDE**3 + 12
_BYTES_PER_NEIGHBOUR = 100
"""Memory of a block near a camera while blocks are collected."""
_HALF_DIAGONAL = 0.5 * np.sqrt(3.0)


@dataclasses.dataclass(frozen=True, eq=False)
class DistanceField:
    """Distances from the surface at the centres of voxels, in the frame of a mission."""

    voxel_size_m: float
    max_distance_m: float  # no distance is larger
    coordinates: I32  # (B, 3) blocks, sorted, in units of the block's side
    distance_m: F32  # (B, 8, 8, 8) positive in free space, negative behind surfaces; NaN = unknown

    def centres(self, blocks: slice = slice(None)) -> F64:
        """Return the centres (b, 8, 8, 8, 3) of the voxels of blocks."""
        return voxel_centres(self.coordinates[blocks], self.voxel_size_m)

    def at(self, p: F64) -> F64:
        """Return the distances (N,) of the voxels in which points (N, 3) lie; NaN = unknown."""
        voxel = np.floor(np.asarray(p) / self.voxel_size_m).astype(np.int64)
        block = voxel // BLOCK_SIDE
        row = rows_in(self.coordinates, block)
        i, j, k = (voxel - block * BLOCK_SIDE).T
        distance: F64 = self.distance_m[row, i, j, k].astype(np.float64)
        distance[row < 0] = np.nan
        return distance


def voxel_centres(coordinates: I32, voxel_size_m: float) -> F64:
    """Return the centres (B, 8, 8, 8, 3) [m] of the voxels of blocks (B, 3)."""
    offsets = np.moveaxis(np.indices(BLOCK_SHAPE), 0, -1)
    voxels = coordinates[:, None, None, None].astype(np.int64) * BLOCK_SIDE + offsets
    centres: F64 = voxels + np.float64(0.5)
    return centres * voxel_size_m


def distance_field(
    grid: TsdfGrid,
    cameras: F64,
    options: DistanceOptions,
    min_weight: float,
    progress: Progress = SILENT,
) -> DistanceField:
    """Return the distances of a grid's voxels from its mesh, exact up to the rounding of float32.

    A voxel is known if it has been seen to be free, or lies behind a surface with at least the weight
    that the mesh needs.

    Args:
        grid: Truncated distances, with the free space.
        cameras: Positions (K, 3) of the cameras in the frame of the grid.
        options: Largest distance, and the spheres around the cameras.
        min_weight: Weight from which voxels count as observed for the mesh.

    Raises:
        EstimationError: The grid has no surface of this weight.
        NotEnoughMemory: The field exceeds the allowed memory.
    """
    mesh = grid.mesh(min_weight)
    if not len(mesh.faces):
        raise EstimationError(
            f"the grid has no surface of weight {min_weight:g}: lower --dense_tsdf_mesh_min_weight"
        )
    tree = TriangleTree(mesh.p, mesh.faces)
    size_m = grid.settings.voxel_size_m
    coordinates = grid.coordinates
    if options.use_clear_sphere:
        around = _blocks_around(cameras, options.clear_sphere_outer_radius, BLOCK_SIDE * size_m)
        coordinates = np.unique(np.concatenate([coordinates, around]), axis=0)
    require_memory(len(coordinates) * _BYTES_PER_BLOCK, "the distance field")
    row = rows_in(grid.coordinates, coordinates)
    distance = np.empty((len(coordinates), *BLOCK_SHAPE), dtype=np.float32)
    for first in range(0, len(coordinates), _BLOCKS_AT_A_TIME):
        progress.step(first, len(coordinates), "distances from the surface")
        part = slice(first, first + _BLOCKS_AT_A_TIME)
        centres = voxel_centres(coordinates[part], size_m)
        known, is_behind = _observed(grid, row[part], min_weight)
        if options.use_clear_sphere:
            spheres = _in_spheres(centres, cameras, options) & ~known[..., None]
            known |= spheres[..., 0]
        distance[part] = _signed(tree, centres, known, is_behind, options.max_distance_m)
        if options.use_clear_sphere:
            distance[part][spheres[..., 1]] = -options.max_distance_m
    kept = np.isfinite(distance).any(axis=(1, 2, 3))
    return DistanceField(size_m, options.max_distance_m, coordinates[kept], distance[kept])


def _observed(grid: TsdfGrid, rows: I64, min_weight: float) -> tuple[Mask, Mask]:
    """Return which voxels (b, 8, 8, 8) are known, and which of these lie behind a surface.

    Args:
        rows: Rows (b,) of the blocks, -1 = not in the grid.
        min_weight: See `distance_field`.
    """
    weight = np.where((rows >= 0)[:, None, None, None], grid.weight[rows], np.float32(0.0))
    is_behind = grid.distance[rows] < 0.0
    known = (weight > 0.0) & (~is_behind | (weight >= min_weight))
    return known, is_behind & known


def _signed(tree: TriangleTree, centres: F64, known: Mask, is_behind: Mask, limit: float) -> F32:
    """Return the distances of voxels, NaN where they are not known."""
    result = np.full(known.shape, np.nan, dtype=np.float32)
    result[known] = tree.distances(centres[known], limit)
    return np.where(is_behind, -result, result)


def _in_spheres(centres: F64, cameras: F64, options: DistanceOptions) -> Mask:
    """Return which voxels are in the inner spheres, and which only in the outer ones (..., 2)."""
    inner, outer = options.clear_sphere_inner_radius, options.clear_sphere_outer_radius
    bound = np.nextafter(outer, np.inf)
    distance = cKDTree(cameras).query(centres.reshape(-1, 3), distance_upper_bound=bound)[0]
    distance = distance.reshape(centres.shape[:-1])
    return np.stack([distance <= inner, (distance > inner) & (distance <= outer)], axis=-1)


def _blocks_around(cameras: F64, radius_m: float, block_m: float) -> I32:
    """Return blocks (B, 3) that a sphere about a camera (K, 3) may touch."""
    home = np.unique(np.floor(cameras / block_m).astype(np.int64), axis=0)
    reach = int(np.ceil(radius_m / block_m))
    count = len(home) * (2.0 * reach + 1.0) ** 3
    require_memory(count * _BYTES_PER_NEIGHBOUR, "the spheres around the cameras")
    steps = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 3, indexing="ij"), -1)
    blocks = np.unique((home[:, None] + steps.reshape(-1, 3)).reshape(-1, 3), axis=0)
    distance = cKDTree(cameras).query((blocks + 0.5) * block_m)[0]
    near = distance <= radius_m + _HALF_DIAGONAL * block_m
    return np.asarray(blocks[near], dtype=np.int32)


_FORMAT = GridFormat("esdf 1", "distance field", "create_esdf_from_depth_resource")


def encode_field(field: DistanceField) -> bytes:
    """Return the content of the file; equal fields give equal bytes."""
    header = {
        "voxel_size_m": field.voxel_size_m,
        "max_distance_m": field.max_distance_m,
        "blocks": len(field.coordinates),
    }
    return encode_arrays(_FORMAT, header, (field.coordinates, field.distance_m))


def decode_field(data: bytes, source: str) -> DistanceField:
    """Read the content of a file.

    Raises:
        MapError: It is no such file, or damaged; names the source.
    """
    content = GridContent(_FORMAT, data, source)
    blocks = content.count("blocks")
    return DistanceField(
        float(content.value("voxel_size_m")),
        float(content.value("max_distance_m")),
        content.array("<i4", (blocks, 3)),
        content.array("<f4", (blocks, *BLOCK_SHAPE)),
    )


FIELD_TYPE = 19
"""Number of the resource type of Euclidean signed distance fields."""


@dataclasses.dataclass(frozen=True)
class FieldReport:
    """One distance field."""

    mission: str  # owner
    missions: int  # whose depth is in it
    depth_maps: int
    blocks: int
    known_voxels: int
    free_share: float  # of the known voxels
    megabytes: float


class FieldsReport(Report):
    """Euclidean signed distance fields; they are written when the map is saved."""

    resource_type: str
    fields: tuple[FieldReport, ...]
    notes: tuple[str, ...] = ()


def create_fields(
    vi_map: VIMap,
    map_folder: Path,
    missions: I64 | None = None,
    options: DistanceOptions | None = None,
    fusion: FusionOptions | None = None,
    *,
    min_weight: float = MESH_MIN_WEIGHT,
    input_type: int | None = None,
    overwrite: bool = False,
    progress: Progress = SILENT,
) -> tuple[VIMap, FieldsReport]:
    """Fuse depth, and compute the distances of all observed voxels from the surface.

    There is one field for all missions in a common frame, and one for each other mission. It belongs to
    the first of its missions and is in the frame of that mission.

    Args:
        missions: Rows of missions; None = all.
        min_weight: Weight from which voxels count as observed for the surface.
        input_type: Number of the resource type of the depth; None = see `depth_type`.

    Raises:
        UserError: There is no depth, or a mission has a field already.
        MapError: A file is missing, damaged, or of another size than the camera's images.
        EstimationError: The depth has no surface of this weight.
        NotEnoughMemory: A field exceeds the allowed memory.
    """
    options, fusion = options or DistanceOptions(), fusion or FusionOptions()
    rows = np.array(chosen_missions(vi_map, missions))
    kind = depth_inputs.depth_type(vi_map, rows, input_type)
    former = resources_of(vi_map, (FIELD_TYPE,), rows)
    if former.any() and not overwrite:
        raise UserError(
            f"there is a distance field of {counted(int(np.count_nonzero(former)), 'mission')} already: "
            "give --overwrite to replace it"
        )
    groups, notes = depth_inputs.mission_groups(vi_map, rows)
    depth = depth_inputs.DepthViews(vi_map, map_folder, kind)
    new = NewResources(seed=b"distance field")
    reports, owners = [], []
    for group in groups:
        resources = depth.of_missions(group)[:: fusion.integrate_every_nth]
        if not len(resources):
            notes.append(
                f"mission {depth_inputs.short_id(vi_map, group[0])}: no {resource_type(kind).name}"
            )
            continue
        poses = depth.poses(resources, se3.inverse(vi_map.T_G_M[group[0]]))
        scene = depth_inputs.SceneDepth.of(depth, resources, fusion)
        settings = depth_inputs.grid_settings(fusion, scene)
        grid = depth_inputs.fuse_views(
            depth, resources, poses, settings, progress, with_free_space=True
        )
        field = distance_field(grid, poses[:, 4:], options, min_weight, progress)
        new.add(FIELD_TYPE, encode_field(field))
        owners.append(group[0])
        reports.append(_report(vi_map, group, field, len(resources)))
    kept = without_resources(vi_map, former)
    result = new.attached(kept, np.arange(len(new)), owners, ResourceOwner.MISSION)
    return result, FieldsReport(resource_type(kind).name, tuple(reports), tuple(notes))


def load_fields(
    vi_map: VIMap, map_folder: Path, missions: I64 | None = None
) -> list[tuple[int, DistanceField]]:
    """Return the distance fields of missions (rows, None = all) with the missions that own them.

    Raises:
        UserError: There is none.
        MapError: A file is missing, damaged, or of C++ maplab.
    """
    chosen = np.array(chosen_missions(vi_map, missions))
    rows = np.flatnonzero(resources_of(vi_map, (FIELD_TYPE,), chosen))
    if not len(rows):
        raise UserError(
            "the map has no distance field: create_esdf_from_depth_resource makes one",
            remedy="create_esdf_from_depth_resource",
        )
    store, table = ResourceStore(vi_map, map_folder), vi_map.resources
    return [
        (
            int(table.owner[row]),
            decode_field(store.load(row), f"distance field {to_hex(table.id[row])}"),
        )
        for row in rows.tolist()
    ]


def export_voxels(
    vi_map: VIMap,
    map_folder: Path,
    file: Path,
    missions: I64 | None = None,
    *,
    overwrite: bool = False,
) -> None:
    """Write the known voxels of the fields of missions (rows, None = all) as a cloud in G.

    The intensity of a point is the signed distance [m].

    Raises:
        UserError: There is no field, or the file cannot be written.
    """
    points, distances = known_voxels(vi_map, load_fields(vi_map, map_folder, missions))
    write_ply(PlyCloud(points, intensity=distances), file, overwrite=overwrite)


def known_voxels(vi_map: VIMap, fields: list[tuple[int, DistanceField]]) -> tuple[F64, F64]:
    """Return the centres (N, 3) in G of the known voxels of fields, and their distances (N,) [m]."""
    points, distances = [], []
    for mission, field in fields:
        known = np.isfinite(field.distance_m)
        points.append(se3.transform(vi_map.T_G_M[mission], field.centres()[known]))
        distances.append(field.distance_m[known].astype(np.float64))
    return np.concatenate(points), np.concatenate(distances)


def _report(vi_map: VIMap, group: list[int], field: DistanceField, maps: int) -> FieldReport:
    known = int(np.count_nonzero(np.isfinite(field.distance_m)))
    free = int(np.count_nonzero(field.distance_m >= 0.0))
    return FieldReport(
        mission=to_hex(vi_map.missions.id[group[0]]),
        missions=len(group),
        depth_maps=maps,
        blocks=len(field.coordinates),
        known_voxels=known,
        free_share=free / max(known, 1),
        megabytes=(field.coordinates.nbytes + field.distance_m.nbytes) / 1e6,
    )
