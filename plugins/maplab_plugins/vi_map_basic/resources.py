"""Resource folders of the selected map: where images, depth maps and the like are kept."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from maplab_py.plugin import CommandContext, Message, Report, UserError, command
from maplab_py.storage.resource_types import resource_type
from maplab_py.vimap import ResourceOwner, VIMap

MAP_FOLDER = -1
"""Index that stands for the map's own resource folder."""


@dataclasses.dataclass(frozen=True)
class ResourceFolderLine:
    """One resource folder."""

    folder: str
    kind: str
    resources: int
    is_used_for_new: bool


@dataclasses.dataclass(frozen=True)
class ResourceFolderList(Report):
    """The map's resource folders."""

    folders: tuple[ResourceFolderLine, ...]


@dataclasses.dataclass(frozen=True)
class ResourceCount:
    """How many resources of one type belong to one kind of owner."""

    resource_type: str
    owner: str
    resources: int


@dataclasses.dataclass(frozen=True)
class ResourceStatistics(Report):
    """How many resources of which type there are."""

    types: tuple[ResourceCount, ...]


@command("list_resource_folders")
def list_resource_folders(context: CommandContext) -> ResourceFolderList:
    """List the selected map's resource folders and which one new resources go to."""
    metadata = context.vi_map.metadata
    external = enumerate(metadata.external_resource_folders)
    folders = [
        (MAP_FOLDER, metadata.map_resource_folder, "map"),
        *((i, f, "external") for i, f in external),
    ]
    counts = context.vi_map.resources.folder
    return ResourceFolderList(
        tuple(
            ResourceFolderLine(
                folder,
                kind,
                int(np.count_nonzero(counts == index)),
                index == metadata.resource_folder_in_use,
            )
            for index, folder, kind in folders
        )
    )


@command("resource_statistics", "res_stats")
def resource_statistics(context: CommandContext) -> ResourceStatistics | Message:
    """Count the selected map's resources by type and by what they belong to."""
    resources = context.vi_map.resources
    if not len(resources):
        return Message(f"map '{context.map_key}' has no resources")
    pairs = np.stack([resources.type, resources.owner_kind], axis=1)
    kinds, counts = np.unique(pairs, axis=0, return_counts=True)
    return ResourceStatistics(
        tuple(
            ResourceCount(
                resource_type(int(kind)).name, ResourceOwner(int(owner)).name.lower(), int(count)
            )
            for (kind, owner), count in zip(kinds, counts, strict=True)
        )
    )


@command("use_map_resource_folder")
def use_map_resource_folder(context: CommandContext) -> Message:
    """Let new resources go to the map's own resource folder."""
    context.commit(_using(context.vi_map, MAP_FOLDER))
    return Message("new resources go to the map's own resource folder")


@command("use_external_resource_folder", example="use_external_resource_folder images")
def use_external_resource_folder(context: CommandContext, resource_folder: Path) -> Message:
    """Let new resources go to a folder outside the map.

    Args:
        resource_folder: The folder, which must exist; it is noted with its full path.
    """
    if not resource_folder.is_dir():
        raise UserError(f"--resource_folder={resource_folder}: there is no such folder")
    folder = str(resource_folder.resolve())
    known = context.vi_map.metadata.external_resource_folders
    folders = known if folder in known else (*known, folder)
    metadata = dataclasses.replace(context.vi_map.metadata, external_resource_folders=folders)
    context.commit(_using(context.vi_map.replace(metadata=metadata), folders.index(folder)))
    return Message(f"new resources go to {folder}")


def _using(vi_map: VIMap, index: int) -> VIMap:
    return vi_map.replace(
        metadata=dataclasses.replace(vi_map.metadata, resource_folder_in_use=index)
    )
