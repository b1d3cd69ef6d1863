"""Merge the missions of one map into another."""

import dataclasses
from pathlib import Path

import numpy as np

from maplab_py.array_types import I32
from maplab_py.errors import MapError
from maplab_py.report import Report
from maplab_py.vimap import edits, sensor_merge, tables
from maplab_py.vimap.ids import as_keys, is_valid, random_ids, to_hex, to_hex_list
from maplab_py.vimap.vi_map import MapMetadata, VIMap

_UNIQUE_TABLES = {
    "missions": "mission",
    "baseframes": "base frame",
    "vertices": "vertex",
    "landmarks": "landmark",
    "imu_edges": "IMU edge",
    "transformation_edges": "transformation edge",
    "loop_closure_edges": "loop closure edge",
    "frames": "frame",
}


class MergeReport(Report):
    """Missions and sensors added by a merge."""

    missions_added: tuple[str, ...]  # ids they have now
    vertices_added: int
    landmarks_added: int
    assigned_new_ids: bool
    sensors_shared: tuple[str, ...]
    sensors_renamed: tuple[tuple[str, str], ...]  # (old id, new id): the calibration differed


def merge_maps(
    base: VIMap, other: VIMap, *, assign_new_ids: bool = False
) -> tuple[VIMap, MergeReport]:
    """Return `base` with the missions of `other` added.

    Sensors with equal calibration are shared. If the calibrations differ, both sensors are kept and
    that of the other map gets a new id, derived from the content of both maps.

    Args:
        base: The map whose metadata are kept and whose missions come first.
        other: The map whose missions are added.
        assign_new_ids: Assign new ids to `other` first, so that the map can hold a recording
            twice.

    Raises:
        MapError: An id of `other` is in `base` already and `assign_new_ids` is off.
    """
    if assign_new_ids:
        other = edits.with_new_ids(other, edits.content_rng(base, "merge", other))
    check_disjoint(base, other)
    other, shared, renamed = with_compatible_sensors(base, other)
    merged = stack(base, other)
    report = MergeReport(
        missions_added=tuple(to_hex_list(other.missions.id)),
        vertices_added=len(other.vertices),
        landmarks_added=len(other.landmarks),
        assigned_new_ids=assign_new_ids,
        sensors_shared=shared,
        sensors_renamed=renamed,
    )
    return merged, report


def with_compatible_sensors(
    base: VIMap, other: VIMap
) -> tuple[VIMap, tuple[str, ...], tuple[tuple[str, str], ...]]:
    """Rename the other map's sensors whose calibration differs from the base's of the same id.

    Returns:
        The other map, the ids of shared sensors, and (old id, new id) of renamed ones.
    """
    conflicts = sensor_merge.conflicting_sensors(base.sensors, other.sensors)
    renamed: tuple[tuple[str, str], ...] = ()
    if conflicts:
        new_ids = random_ids(len(conflicts), edits.content_rng(base, "sensors", other))
        renamed = tuple(zip(conflicts, to_hex_list(new_ids), strict=True))
    shared = tuple(
        sensor_id
        for sensor_id in other.sensors.sensors
        if sensor_id in base.sensors.sensors and sensor_id not in conflicts
    )
    return sensor_merge.with_renamed_sensors(other, dict(renamed)), shared, renamed


def check_disjoint(base: VIMap, other: VIMap) -> None:
    """Check that two maps have no ids in common.

    Raises:
        MapError: They have.
    """
    for name, noun in _UNIQUE_TABLES.items():
        mine, theirs = getattr(base, name).id, getattr(other, name).id
        clash = np.flatnonzero(np.isin(as_keys(theirs), as_keys(mine)) & is_valid(theirs))
        if len(clash):
            raise MapError(
                f"{noun} {to_hex(theirs[clash[0]])} is in both maps ({len(clash)} equal {noun} "
                "ids): use --assign_new_ids to keep both, or, if these are pieces of "
                "one mission, load_merge_submap or load_merge_all_submaps"
            )


# Concatenate the tables of two maps.


def stack(base: VIMap, other: VIMap) -> VIMap:
    """Return a map with the rows of `base`, then those of `other`, references shifted.

    Nothing is merged or sorted; base's sensors are used where ids are equal.
    """
    v, m = len(base.vertices), len(base.missions)
    missions = other.missions.replace(
        baseframe=_shift(other.missions.baseframe, len(base.baseframes)),
        root_vertex=_shift(other.missions.root_vertex, v),
    )
    frames = other.frames.replace(vertex=_shift(other.frames.vertex, v))
    landmarks = other.landmarks.replace(vertex=_shift(other.landmarks.vertex, v))
    keypoints = other.keypoints.replace(
        landmark=_shift(other.keypoints.landmark, len(base.landmarks))
    )
    absolute = other.absolute_poses.replace(vertex=_shift(other.absolute_poses.vertex, v))
    metadata, folder = _joined_metadata(base.metadata, other)
    resources = _shift_resources(other.resources.replace(folder=folder), len(base.frames), m)
    imu, loops, relative = other.imu_edges, other.loop_closure_edges, other.transformation_edges
    imu = imu.replace(from_vertex=_shift(imu.from_vertex, v), to_vertex=_shift(imu.to_vertex, v))
    loops = loops.replace(
        from_vertex=_shift(loops.from_vertex, v), to_vertex=_shift(loops.to_vertex, v)
    )
    relative = relative.replace(
        from_vertex=_shift(relative.from_vertex, v), to_vertex=_shift(relative.to_vertex, v)
    )
    vertices = other.vertices.replace(mission=_shift(other.vertices.mission, m))
    return base.replace(
        sensors=sensor_merge.union(base.sensors, other.sensors),
        metadata=metadata,
        missions=tables.Missions.concatenate([base.missions, missions]),
        baseframes=tables.BaseFrames.concatenate([base.baseframes, other.baseframes]),
        vertices=tables.Vertices.concatenate([base.vertices, vertices]),
        frames=tables.Frames.concatenate([base.frames, frames]),
        keypoints=tables.Keypoints.concatenate([base.keypoints, keypoints]),
        landmarks=tables.Landmarks.concatenate([base.landmarks, landmarks]),
        imu_edges=tables.ImuEdges.concatenate([base.imu_edges, imu]),
        imu_samples=tables.ImuSamples.concatenate([base.imu_samples, other.imu_samples]),
        transformation_edges=tables.TransformationEdges.concatenate(
            [base.transformation_edges, relative]
        ),
        loop_closure_edges=tables.LoopClosureEdges.concatenate([base.loop_closure_edges, loops]),
        absolute_poses=tables.AbsolutePoses.concatenate([base.absolute_poses, absolute]),
        resources=tables.Resources.concatenate([base.resources, resources]),
    )


def _shift(rows: I32, offset: int) -> I32:
    return np.where(rows >= 0, rows + offset, rows).astype(np.int32)


def _shift_resources(resources: tables.Resources, frames: int, missions: int) -> tables.Resources:
    offset = np.where(resources.owner_kind == tables.ResourceOwner.FRAME, frames, missions)
    owned = (resources.owner_kind != tables.ResourceOwner.NONE) & (resources.owner >= 0)
    return resources.replace(owner=np.where(owned, resources.owner + offset, resources.owner))


def at_folder(vi_map: VIMap, folder: Path | None) -> VIMap:
    """Return a map that is about to be merged, whose own resources lie in the folder that it was loaded from.

    Its metadata name another one if it was moved, or none.
    """
    if folder is None:
        return vi_map
    metadata = dataclasses.replace(vi_map.metadata, map_folder=str(folder.absolute()))
    return vi_map.replace(metadata=metadata)


def without_folder(vi_map: VIMap, folder: Path | None) -> VIMap:
    """Return a map that becomes part of a new one; its own resources stay in its folder of now."""
    metadata, column = _joined_metadata(vi_map.metadata, at_folder(vi_map, folder))
    return vi_map.replace(metadata=metadata, resources=vi_map.resources.replace(folder=column))


def resource_folder_name(metadata: MapMetadata) -> str:
    """Return the name under which another map lists a map's own resource folder."""
    return f"{metadata.map_folder.rstrip('/')}/{metadata.map_resource_folder.removeprefix('./')}"


def _joined_metadata(base: MapMetadata, other: VIMap) -> tuple[MapMetadata, I32]:
    """Add the other map's resource folders to the base's; return them and the new folder column.

    Resources in the other map's own folder are found there as in an external one.
    """
    folder = other.resources.folder.copy()
    if len(folder) == 0:
        return base, folder
    known = list(base.external_resource_folders)
    names = dict(enumerate(other.metadata.external_resource_folders))
    if np.any(folder == -1):
        names[-1] = resource_folder_name(other.metadata)
    for index, name in names.items():
        if name not in known:
            known.append(name)
        folder[other.resources.folder == index] = known.index(name)
    staged = base.staged_folders
    staged += tuple(new for new in other.metadata.staged_folders if new not in staged)
    metadata = dataclasses.replace(
        base, external_resource_folders=tuple(known), staged_folders=staged
    )
    return metadata, folder
