"""Concatenate the tables of two maps."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.array_types import I32
from maplab_py.vimap import tables
from maplab_py.vimap.sensor_merge import union
from maplab_py.vimap.vi_map import MapMetadata, VIMap


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
        sensors=union(base.sensors, other.sensors),
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
