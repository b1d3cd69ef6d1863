"""Resource folders of the selected map: where images, depth maps and other files are stored."""

import dataclasses
from pathlib import Path

import numpy as np

from maplab_py.plugin import (
    ALL_MISSIONS,
    CommandContext,
    Message,
    MissionChoice,
    Report,
    UserError,
    command,
)
from maplab_py.report import counted
from maplab_py.storage.resources.types import resource_type
from maplab_py.vimap import ResourceOwner, VIMap

MAP_FOLDER = -1
"""Index of the resource folder inside the map folder."""


@dataclasses.dataclass(frozen=True)
class ResourceFolderLine:
    """One resource folder."""

    folder: str
    kind: str
    resources: int
    is_used_for_new: bool


class ResourceFolderList(Report):
    """The map's resource folders."""

    folders: tuple[ResourceFolderLine, ...]


@dataclasses.dataclass(frozen=True)
class ResourceCount:
    """Number of resources of one type and one kind of owner."""

    resource_type: str
    owner: str
    resources: int


class ResourceStatistics(Report):
    """Number of resources by type."""

    types: tuple[ResourceCount, ...]


@dataclasses.dataclass(frozen=True)
class CacheLine:
    """Use of the cache by one resource type."""

    resource_type: str
    hits: int
    misses: int
    entries: int
    megabytes: float


class CacheReport(Report):
    """Use of the cache of resources since the program started."""

    types: tuple[CacheLine, ...]


class CleanUpReport(Report):
    """Resource folders that were merged, and files that no resource refers to."""

    merged_folders: tuple[str, ...]
    orphaned_files: int
    removed_files: int
    problems: tuple[str, ...] = ()

    @property
    def failure(self) -> str:
        """List the files that could not be deleted."""
        return "; ".join(self.problems)


@command("list_resource_folders")
def list_resource_folders(context: CommandContext) -> ResourceFolderList:
    """List the resource folders of the selected map and the one for new resources."""
    metadata = context.vi_map.metadata
    external = enumerate(metadata.external_resource_folders)
    staged = {str(folder.path) for folder in metadata.staged_folders}
    folders = [
        (MAP_FOLDER, metadata.map_resource_folder, "map"),
        *((i, f, "temporary" if f in staged else "external") for i, f in external),
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
    """Count the resources of the selected map by type and owner."""
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
    """Store new resources in the resource folder inside the map folder."""
    context.commit(_using(context.vi_map, MAP_FOLDER))
    return Message("new resources are stored in the map folder")


@command("use_external_resource_folder", example="use_external_resource_folder images")
def use_external_resource_folder(context: CommandContext, resource_folder: Path) -> Message:
    """Store new resources in a folder outside the map.

    Args:
        resource_folder: An existing folder; its absolute path is stored.
    """
    if not resource_folder.is_dir():
        raise UserError(f"--resource_folder={resource_folder}: there is no such folder")
    folder = str(resource_folder.resolve())
    known = context.vi_map.metadata.external_resource_folders
    folders = known if folder in known else (*known, folder)
    metadata = dataclasses.replace(context.vi_map.metadata, external_resource_folders=folders)
    context.commit(_using(context.vi_map.replace(metadata=metadata), folders.index(folder)))
    return Message(f"new resources are stored in {folder}")


@command("resource_cache_statistics", "res_cache_stats")
def resource_cache_statistics(_: CommandContext) -> CacheReport | Message:
    """Show how often resources came from the cache (hits) and from disk (misses), by type."""
    from maplab_py.storage.resources.store import SHARED_CACHE

    kinds = SHARED_CACHE.kinds()
    if not kinds:
        return Message("no resources have been read yet")
    lines = []
    for kind in kinds:
        counts = SHARED_CACHE.statistics(kind)
        lines.append(
            CacheLine(
                resource_type(kind).name,
                counts.hits,
                counts.misses,
                counts.entries,
                counts.bytes / 1e6,
            )
        )
    return CacheReport(tuple(lines))


@command(
    "remove_resources",
    example="remove_resources raw_images",
    see_also=("resource_statistics", "clean_up_resource_folders"),
)
def remove_resources(
    context: CommandContext, resource_type: str, *, missions: MissionChoice = ALL_MISSIONS
) -> Message:
    """Remove all resources of a type from the map; undo brings them back.

    Their files stay in the map's folder until `clean_up_resource_folders --remove_orphans`.

    Args:
        resource_type: Number or name of the type, as `resource_statistics` lists them.
    """
    from maplab_py.storage.resources.types import resource_type_of
    from maplab_py.vimap.queries import resources_of, without_resources

    kind = resource_type_of(resource_type)
    removed = resources_of(context.vi_map, (kind.number,), missions.rows(context.vi_map))
    if not removed.any():
        raise UserError(f"remove_resources: there are no resources of type {kind.name}")
    context.commit(without_resources(context.vi_map, removed))
    number = counted(int(np.count_nonzero(removed)), "resource")
    return Message(f"removed {number} of type {kind.name}")


@command(
    "clean_up_resource_folders",
    example="clean_up_resource_folders --remove_orphans --yes",
    guards_effects=True,
    obeys_dry_run=True,
    see_also=("list_resource_folders", "remove_resources", "check_map_consistency"),
)
def clean_up_resource_folders(
    context: CommandContext, *, remove_orphans: bool = False, yes: bool = False
) -> CleanUpReport:
    """Merge resource folders that are the same, and delete files that no resource refers to.

    Only the map's own folder is searched for such files, because maps that are not loaded may use
    external folders.

    Args:
        remove_orphans: Delete the files; the map must be saved. Undo does not bring them back.
        yes: Do not ask before files are deleted.
    """
    from maplab_py.storage.resources.files import orphaned_files, remove_files, with_merged_folders

    vi_map, folder = context.vi_map, context.map_folder
    others = [entry.vi_map for entry in context.maps if entry.key != context.map_key]
    orphans = orphaned_files(others, vi_map, folder)
    merged_map, merged = with_merged_folders(vi_map, folder)
    removed, problems = 0, list[str]()
    if remove_orphans and orphans:
        if not context.maps.selected.is_saved:
            raise UserError(
                f"clean_up_resource_folders: map '{context.map_key}' has changes that are not on disk: "
                "save it first, for the saved map may need the files"
            )
        question = f"delete {counted(len(orphans), 'file')} below {folder}, first {orphans[0]}?"
        context.confirm(question, yes=yes)
        if not context.is_trial:
            removed, problems = remove_files(orphans)
    context.commit(merged_map)
    return CleanUpReport(tuple(merged), len(orphans), removed, tuple(problems))


def _using(vi_map: VIMap, index: int) -> VIMap:
    return vi_map.replace(
        metadata=dataclasses.replace(vi_map.metadata, resource_folder_in_use=index)
    )
