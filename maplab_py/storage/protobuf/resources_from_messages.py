"""Convert messages to the table of resources of frames, missions and sensors."""

from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.array_types import I64
from maplab_py.errors import MapError
from maplab_py.storage import maplab_map_pb2 as pb
from maplab_py.storage.protobuf import map_files, scan
from maplab_py.storage.protobuf.ids import ids_of
from maplab_py.storage.protobuf.tables_from_messages import Content
from maplab_py.vimap import MapMetadata, ResourceOwner, Resources, as_keys


def read_metadata(folder: Path, max_bytes: int) -> tuple[MapMetadata, list[str]]:
    """Return the content of the folder's `metadata` file and notes; defaults if it is missing."""
    path = folder / map_files.METADATA
    if not path.is_file():
        return MapMetadata(map_folder=str(folder)), []
    message, notes = pb.MetaData(), []
    try:
        map_files.read_text_message(path, message, max_bytes)
    except MapError as error:  # other programs may write more fields, which are not needed here
        message = pb.MetaData()
        map_files.read_text_message(path, message, max_bytes, allow_unknown_field=True)
        notes.append(f"{str(error).removeprefix(f'{folder}/')}: the unknown field is ignored")
    in_use = message.resource_folder_in_use if message.HasField("resource_folder_in_use") else -1
    metadata = MapMetadata(
        description=message.map_description,
        map_folder=message.map_folder,
        resource_folder_in_use=in_use,
        map_resource_folder=message.map_resource_folder or "./resources/",
        external_resource_folders=tuple(message.external_resource_folders),
    )
    return metadata, notes


def read_resources(
    folder: Path, of_frames: Resources, content: Content, budget: scan.MemoryBudget
) -> Resources:
    """Return all references, with the folder that resource_info gives for each.

    Args:
        of_frames: Those of the frames (`resources_of_frames`).

    Raises:
        MapError: resource_info is damaged, or a mission's lists differ in length.
    """
    parts = [
        of_frames,
        _of_missions(content),
        _of_sensors(content.missions),
    ]
    table = Resources.concatenate(parts)
    path = folder / map_files.RESOURCE_INFO
    if not path.is_file() or not path.stat().st_size:
        return table
    info = pb.ResourceInfoMap()
    map_files.read_message(path, info, budget)
    if not len(info.resource_type) == len(info.resource_id) == len(info.resource_info):
        raise MapError(f"{path}: its three lists differ in length")
    if not all(entry.HasField("folder_idx") for entry in info.resource_info):
        raise MapError(f"{path}: an entry of resource_info has no folder_idx")
    ids = ids_of(info.resource_id, "resource_id", lambda _: str(path))
    places = np.array([entry.folder_idx for entry in info.resource_info], dtype=np.int32)
    types = np.array(list(info.resource_type), dtype=np.int32)
    known = {key: at for at, key in enumerate(as_keys(ids).tolist())}
    at = np.array([known.get(key, -1) for key in as_keys(table.id).tolist()], dtype=np.int64)
    where = np.where(at >= 0, places[at], -1) if len(places) else np.full(len(table), -1)
    loose = np.setdiff1d(np.arange(len(ids)), at)
    unattached = Resources.filled(
        len(loose), id=ids[loose], type=types[loose], folder=places[loose]
    )
    return Resources.concatenate([table.replace(folder=where), unattached])


def resources_of_frames(vertices: list[Any], frame_start: I64) -> Resources:
    """Return the references of the vertices' frames; `frame_start` (V + 1,) has the frames' rows."""
    entries = [
        (int(frame_start[row]) + camera, entry.type, resource)
        for row, vertex in enumerate(vertices)
        for camera, owned in enumerate(vertex.frame_resources)
        for entry in owned.resources
        for resource in entry.resource_ids
    ]
    return Resources.filled(
        len(entries),
        id=ids_of([r for _, _, r in entries], "resource of a frame"),
        type=[kind for _, kind, _ in entries],
        owner_kind=[ResourceOwner.FRAME] * len(entries),
        owner=[frame for frame, _, _ in entries],
    )


def _of_missions(content: Content) -> Resources:
    for row, mission in enumerate(content.missions):
        if len(mission.resource_ids) != len(mission.resource_types):
            raise MapError(
                f"{content.name('missions', row)}: resource_ids and resource_types differ in length"
            )
    entries = [
        (row, kind, resource)
        for row, mission in enumerate(content.missions)
        for kind, resource in zip(mission.resource_types, mission.resource_ids, strict=True)
    ]
    return Resources.filled(
        len(entries),
        id=ids_of([r for _, _, r in entries], "resource of a mission"),
        type=[kind for _, kind, _ in entries],
        owner_kind=[ResourceOwner.MISSION] * len(entries),
        owner=[row for row, _, _ in entries],
    )


def _of_sensors(missions: list[Any]) -> Resources:
    entries = [(row, entry) for row, m in enumerate(missions) for entry in m.sensor_resources]
    return Resources.filled(
        len(entries),
        id=ids_of([e.resource_id for _, e in entries], "resource of a sensor"),
        type=[e.resource_type for _, e in entries],
        owner_kind=[ResourceOwner.SENSOR] * len(entries),
        owner=[row for row, _ in entries],
        sensor_id=ids_of([e.sensor_id for _, e in entries], "sensor of a resource"),
        timestamp_ns=[e.timestamp_ns for _, e in entries],
    )
