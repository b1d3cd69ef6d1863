"""Distance fields of missions, which the map keeps as resources."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from maplab_py.algorithms.dense.distance.field import (
    DistanceField,
    decode_field,
    distance_field,
    encode_field,
)
from maplab_py.algorithms.dense.distance.options import DistanceOptions
from maplab_py.algorithms.dense.fusion.depth_inputs import (
    depth_type,
    fuse_views,
    grid_settings,
    mission_groups,
    short_id,
)
from maplab_py.algorithms.dense.fusion.depth_views import DepthViews
from maplab_py.algorithms.dense.fusion.options import MESH_MIN_WEIGHT, FusionOptions
from maplab_py.algorithms.dense.resources import chosen_missions
from maplab_py.array_types import F64, I64
from maplab_py.errors import UserError
from maplab_py.geometry import se3
from maplab_py.interop.ply import PlyCloud, write_ply
from maplab_py.progress import SILENT, Progress
from maplab_py.report import Report, counted
from maplab_py.storage.new_resources import NewResources
from maplab_py.storage.resource_types import resource_type
from maplab_py.storage.resources import ResourceStore
from maplab_py.vimap import ResourceOwner, VIMap
from maplab_py.vimap.ids import to_hex
from maplab_py.vimap.resource_queries import resources_of, without_resources

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


@dataclasses.dataclass(frozen=True)
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
        vi_map: Map.
        map_folder: Its folder.
        missions: Rows of missions; None = all.
        options: Distances.
        fusion: Voxels and weights.
        min_weight: Weight from which voxels count as observed for the surface.
        input_type: Number of the resource type of the depth; None = see `depth_type`.
        overwrite: Replace fields that the missions have.
        progress: Is told about every depth map and the blocks.

    Raises:
        UserError: There is no depth, or a mission has a field already.
        MapError: A file is missing, damaged, or of another size than the camera's images.
        EstimationError: The depth has no surface of this weight.
        NotEnoughMemory: A field exceeds the allowed memory.
    """
    options, fusion = options or DistanceOptions(), fusion or FusionOptions()
    rows = np.array(chosen_missions(vi_map, missions))
    kind = depth_type(vi_map, rows, input_type)
    former = resources_of(vi_map, (FIELD_TYPE,), rows)
    if former.any() and not overwrite:
        raise UserError(
            f"there is a distance field of {counted(int(np.count_nonzero(former)), 'mission')} already: "
            "give --overwrite to replace it"
        )
    groups, notes = mission_groups(vi_map, rows)
    depth = DepthViews(vi_map, map_folder, kind)
    new = NewResources(seed=b"distance field")
    reports, owners = [], []
    for group in groups:
        resources = depth.of_missions(group)[:: fusion.integrate_every_nth]
        if not len(resources):
            notes.append(f"mission {short_id(vi_map, group[0])}: no {resource_type(kind).name}")
            continue
        poses = depth.poses(resources, se3.inverse(vi_map.T_G_M[group[0]]))
        settings = grid_settings(fusion)
        grid = fuse_views(depth, resources, poses, settings, progress, with_free_space=True)
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
        raise UserError("the map has no distance field: create_esdf_from_depth_resource makes one")
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
