"""Fusion of the depth maps and clouds of missions into grids that the map keeps as resources."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.algorithms.dense import depth_inputs
from maplab_py.algorithms.dense.grid import (
    BLOCK_SHAPE,
    GridContent,
    GridFormat,
    GridSettings,
    TsdfGrid,
    blocks_of_views,
    encode_arrays,
    rows_in,
)
from maplab_py.algorithms.dense.options import FusionOptions
from maplab_py.algorithms.dense.resources import chosen_missions
from maplab_py.array_types import F64, I64, U64, Mask
from maplab_py.errors import MapError, UserError
from maplab_py.geometry import se3
from maplab_py.progress import SILENT, Progress
from maplab_py.report import Report, counted
from maplab_py.storage.resources.new import NewResources
from maplab_py.storage.resources.store import ResourceStore
from maplab_py.storage.resources.types import resource_type
from maplab_py.vimap import ResourceOwner, VIMap, as_keys, resources_of, to_hex, without_resources

GRID_TYPE = 18
"""Number of the resource type of grids of truncated signed distances."""


@dataclasses.dataclass(frozen=True)
class GridReport:
    """One grid."""

    mission: str  # owner
    missions: int  # whose depth is in it
    depth_maps: int
    added: int
    removed: int
    voxel_size_m: float
    blocks: int
    megabytes: float
    median_depth_m: float = 0.0  # of the depth maps; 0 = not measured
    depth_in_range: float = (
        0.0  # share of their depth between the smallest and largest that is used
    )


class FusionReport(Report):
    """Grids of truncated signed distances; they are written when the map is saved."""

    resource_type: str
    grids: tuple[GridReport, ...]
    notes: tuple[str, ...] = ()


def fuse_depth(
    vi_map: VIMap,
    map_folder: Path,
    missions: I64 | None = None,
    options: FusionOptions | None = None,
    *,
    input_type: int | None = None,
    overwrite: bool = False,
    progress: Progress = SILENT,
) -> tuple[VIMap, FusionReport]:
    """Fuse depth into one grid for all missions in a common frame, and one for each other mission.

    A grid belongs to the first of its missions and is in the frame of that mission.

    Args:
        missions: Rows of missions; None = all.
        input_type: Number of the resource type of the depth; None = the first of optimised depth
            maps, raw depth maps and clouds that there is.

    Raises:
        UserError: There is no depth, or a mission has a grid already.
        MapError: A file is missing, damaged, or of another size than the camera's images.
        EstimationError: A mission has no depth in the range of the options.
        NotEnoughMemory: A grid exceeds the allowed memory.
    """
    options = options or FusionOptions()
    rows = np.array(chosen_missions(vi_map, missions))
    kind = depth_inputs.depth_type(vi_map, rows, input_type)
    former = _grids(vi_map, rows)
    if former.any() and not overwrite:
        raise UserError(
            f"there is a grid of {counted(int(np.count_nonzero(former)), 'mission')} already: give "
            "--overwrite to replace it, or --update to follow changed poses"
        )
    groups, notes = depth_inputs.mission_groups(vi_map, rows)
    depth = depth_inputs.DepthViews(vi_map, map_folder, kind)
    new = NewResources(seed=b"grid")
    reports, owners = [], []
    for group in groups:
        resources = depth.of_missions(group)[:: options.integrate_every_nth]
        if not len(resources):
            notes.append(
                f"mission {depth_inputs.short_id(vi_map, group[0])}: no {resource_type(kind).name}"
            )
            continue
        T_M_G = se3.inverse(vi_map.T_G_M[group[0]])
        poses = depth.poses(resources, T_M_G)
        scene = depth_inputs.SceneDepth.of(depth, resources, options)
        grid = depth_inputs.fuse_views(
            depth, resources, poses, depth_inputs.grid_settings(options, scene), progress
        )
        fused = FusedDepth(vi_map.resources.id[resources], poses)
        new.add(GRID_TYPE, encode_grid(StoredGrid(grid, fused)))
        owners.append(group[0])
        report = _report(vi_map, group, grid, len(resources), len(resources), 0)
        reports.append(
            dataclasses.replace(
                report, median_depth_m=scene.median_m, depth_in_range=scene.share_in_range
            )
        )
    kept = without_resources(vi_map, former)
    result = new.attached(kept, np.arange(len(new)), owners, ResourceOwner.MISSION)
    return result, FusionReport(resource_type(kind).name, tuple(reports), tuple(notes))


def update_grids(
    vi_map: VIMap,
    map_folder: Path,
    missions: I64 | None = None,
    options: FusionOptions | None = None,
    *,
    input_type: int | None = None,
    threshold_m: float = 0.01,
    progress: Progress = SILENT,
) -> tuple[VIMap, FusionReport]:
    """Integrate the depth of frames that have moved again: taken out at the old pose, added at the new.

    Depth resources that the map does not have any more are errors, because nothing could take them out.

    Args:
        missions: Rows of missions; None = all.
        options: What is not at its default must be as in the grids; None = all defaults.
        input_type: Number of the resource type that must be in the grids; None = any.
        threshold_m: Frames whose points at a distance of 2 m have moved by more are integrated again.

    Raises:
        UserError: The missions have no grid, or one of other options.
        MapError: A file is missing or damaged, or a depth map in the grid is not in the map.
    """
    rows = np.array(chosen_missions(vi_map, missions))
    grids = np.flatnonzero(_grids(vi_map, rows))
    if not len(grids):
        raise UserError(
            "the missions have no grid: create_tsdf_from_depth_resource makes one",
            remedy="create_tsdf_from_depth_resource",
        )
    groups, notes = depth_inputs.mission_groups(vi_map, np.arange(len(vi_map.missions)))
    store = ResourceStore(vi_map, map_folder)
    new = NewResources(seed=b"grid")
    reports, owners, kinds, replaced = (
        [],
        [],
        set(),
        np.zeros(len(vi_map.resources), dtype=np.bool_),
    )
    for row in grids.tolist():
        owner = int(vi_map.resources.owner[row])
        group = next((group for group in groups if owner in group), [owner])
        name = f"grid {to_hex(vi_map.resources.id[row])}"
        stored = decode_grid(store.load(row), name)
        _check_settings(stored.grid.settings, options or FusionOptions(), name)
        resources = _rows_of(vi_map, stored.fused)
        depth = depth_inputs.DepthViews(
            vi_map, map_folder, int(vi_map.resources.type[resources[0]])
        )
        if input_type not in (None, depth.kind):
            raise UserError(
                f"{name} is of {resource_type(depth.kind).name}, and --update keeps that: leave out "
                "--dense_depth_resource_input_type, or fuse again with --overwrite"
            )
        kinds.add(depth.kind)
        poses = depth.poses(resources, se3.inverse(vi_map.T_G_M[owner]))
        moved = _motion_m(stored.fused.T_M_C, poses) > threshold_m
        current = np.where(moved[:, None], poses, stored.fused.T_M_C)
        grid, count = stored.grid, int(np.count_nonzero(moved))
        if count:
            grid = _follow(stored, depth, resources, moved, current, progress)
        reports.append(_report(vi_map, group, grid, len(resources), count, count))
        if count:
            fused = FusedDepth(stored.fused.resource_id, current)
            new.add(GRID_TYPE, encode_grid(StoredGrid(grid, fused)))
            owners.append(owner)
            replaced[row] = True
    if owners:
        kept = without_resources(vi_map, replaced)
        vi_map = new.attached(kept, np.arange(len(new)), owners, ResourceOwner.MISSION)
    name = ", ".join(resource_type(kind).name for kind in sorted(kinds))
    return vi_map, FusionReport(name, tuple(reports), tuple(notes))


def _check_settings(settings: GridSettings, options: FusionOptions, source: str) -> None:
    """Refuse options that are given and differ from those of a grid."""
    usual = FusionOptions()
    for name, value in (
        ("voxel_size_m", settings.voxel_size_m),
        ("truncation_distance_m", settings.truncation_m),
        ("min_ray_length_m", settings.min_depth_m),
        ("max_ray_length_m", settings.max_depth_m),
        ("weight_depth_power", settings.depth_power),
        ("max_weight", settings.max_weight),
    ):
        given = getattr(options, name)
        if given not in (getattr(usual, name), value):
            raise UserError(
                f"{source} has --{FusionOptions.flag_prefix}{name}={value:g}, and --update keeps that: "
                f"leave out {given:g}, or fuse again with --overwrite"
            )


def _follow(
    stored: StoredGrid,
    depth: depth_inputs.DepthViews,
    resources: I64,
    moved: Mask,
    T_M_C: F64,
    progress: Progress,
) -> TsdfGrid:
    """Return the grid with the depth maps that have moved at their present poses.

    Afterwards every block has all depth maps again: the others are integrated into new blocks.

    Args:
        stored: Grid with the poses so far.
        resources: Rows (K,) of those in the grid.
        moved: Which of them (K,) have moved.
        T_M_C: Present poses (K, 7) of those, the poses in the grid of the others.
    """
    old, rows = stored.grid, np.flatnonzero(moved)
    grid = dataclasses.replace(old, distance=old.distance.copy(), weight=old.weight.copy())
    what = "updating the grid"
    for view in depth.views(resources[rows], stored.fused.T_M_C[rows], progress, what):
        grid.integrate(*view, sign=-1.0)
    touched = blocks_of_views(
        depth.views(resources[rows], T_M_C[rows], progress, what), grid.settings
    )
    added = TsdfGrid.unobserved(grid.settings, touched[rows_in(grid.coordinates, touched) < 0])
    needed = np.flatnonzero(moved | (len(added.coordinates) > 0))
    views = depth.views(resources[needed], T_M_C[needed], progress, what)
    for view, has_moved in zip(views, moved[needed].tolist(), strict=True):
        if has_moved:
            grid.integrate(*view)
        added.integrate(*view)
    return grid.joined(added)


def load_grids(
    vi_map: VIMap, map_folder: Path, missions: I64 | None = None
) -> list[tuple[int, StoredGrid]]:
    """Return the grids of missions (rows, None = all) with the missions that own them.

    Raises:
        UserError: There is none.
        MapError: A file is missing, damaged, or of C++ maplab.
    """
    rows = np.flatnonzero(_grids(vi_map, np.array(chosen_missions(vi_map, missions))))
    if not len(rows):
        raise UserError(
            "the map has no grid: create_tsdf_from_depth_resource makes one",
            remedy="create_tsdf_from_depth_resource",
        )
    store = ResourceStore(vi_map, map_folder)
    return [
        (
            int(vi_map.resources.owner[row]),
            decode_grid(store.load(row), f"grid {to_hex(vi_map.resources.id[row])}"),
        )
        for row in rows.tolist()
    ]


def _grids(vi_map: VIMap, missions: I64) -> Mask:
    return resources_of(vi_map, (GRID_TYPE,), missions)


def _rows_of(vi_map: VIMap, fused: FusedDepth) -> I64:
    """Return the rows of the depth resources in a grid.

    Raises:
        MapError: The map does not have one of them.
    """
    order = np.argsort(as_keys(vi_map.resources.id))
    keys = as_keys(vi_map.resources.id)[order]
    wanted = as_keys(fused.resource_id)
    place = np.minimum(np.searchsorted(keys, wanted), max(len(keys) - 1, 0))
    missing = keys[place] != wanted
    if missing.any() or not len(wanted):
        raise MapError(
            f"{np.count_nonzero(missing)} depth maps of the grid are not in the map: fuse again by "
            "create_tsdf_from_depth_resource --overwrite"
        )
    return np.asarray(order[place], dtype=np.int64)


def _motion_m(T_M_C: F64, moved_T_M_C: F64) -> F64:
    """Return how far (N,) points at 2 m on the optical axes have moved, or the cameras if further."""
    points = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 2.0]])
    before = se3.transform(T_M_C[:, None], points)
    after = se3.transform(moved_T_M_C[:, None], points)
    return np.asarray(np.linalg.norm(after - before, axis=-1).max(axis=1))


def _report(
    vi_map: VIMap, group: list[int], grid: TsdfGrid, maps: int, added: int, removed: int
) -> GridReport:
    mission_id = to_hex(vi_map.missions.id[group[0]])
    voxel_m = grid.settings.voxel_size_m
    counts = len(group), maps, added, removed
    return GridReport(mission_id, *counts, voxel_m, len(grid.coordinates), grid.nbytes / 1e6)


_FORMAT = GridFormat("tsdf 1", "grid", "create_tsdf_from_depth_resource")
_WHOLE_NUMBERS = ("depth_power",)


@dataclasses.dataclass(frozen=True, eq=False)
class FusedDepth:
    """The depth resources in a grid, and the poses that they were integrated with."""

    resource_id: U64  # (K, 2)
    T_M_C: F64  # (K, 7)


@dataclasses.dataclass(frozen=True, eq=False)
class StoredGrid:
    """A grid in the frame of the mission that owns it."""

    grid: TsdfGrid
    fused: FusedDepth


def encode_grid(stored: StoredGrid) -> bytes:
    """Return the content of the file; equal grids give equal bytes."""
    grid = stored.grid.chosen(np.flatnonzero((stored.grid.weight > 0.0).any(axis=(1, 2, 3))))
    header = {
        **dataclasses.asdict(grid.settings),
        "blocks": len(grid.coordinates),
        "depth_maps": len(stored.fused.resource_id),
    }
    fused = stored.fused
    arrays = grid.coordinates, grid.distance, grid.weight, fused.resource_id, fused.T_M_C
    return encode_arrays(_FORMAT, header, arrays)


def decode_grid(data: bytes, source: str) -> StoredGrid:
    """Read the content of a file.

    Raises:
        MapError: It is no such file, or damaged; names the source.
    """
    content = GridContent(_FORMAT, data, source)
    values: dict[str, Any] = {
        field.name: (content.count if field.name in _WHOLE_NUMBERS else content.value)(field.name)
        for field in dataclasses.fields(GridSettings)
    }
    blocks, maps = content.count("blocks"), content.count("depth_maps")
    coordinates = content.array("<i4", (blocks, 3))
    distance = content.array("<f4", (blocks, *BLOCK_SHAPE))
    weight = content.array("<f4", (blocks, *BLOCK_SHAPE))
    ids, poses = content.array("<u8", (maps, 2)), content.array("<f8", (maps, 7))
    grid = TsdfGrid(GridSettings(**values), coordinates, distance, weight)
    return StoredGrid(grid, FusedDepth(ids.astype(np.uint64), poses.astype(np.float64)))
