"""Loading maps from disk: alone, or merged into the selected map."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

from maplab_py.input_files import SizeOptions
from maplab_py.plugin import CommandContext, Message, Report, UserError, command, key_of_folder
from maplab_py.report import counted, view
from maplab_py.storage.cache.options import CacheOptions

if TYPE_CHECKING:
    from maplab_py.storage.native import MapCache
    from maplab_py.vimap import VIMap


class FolderList(Report):
    """Map folders below a folder."""

    maps_folder: Path
    map_folders: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class LoadedMap:
    """One map that was loaded."""

    map_key: str
    missions: int
    vertices: int
    landmarks: int
    folder: Path


class LoadedMaps(Report):
    """Loaded maps, each under its key."""

    maps: tuple[LoadedMap, ...]
    details: tuple[Report, ...]

    def display(self) -> Any:
        """Return a sentence on one map, else a table."""
        notes = tuple(note for report in self.details for note in getattr(report, "notes", ()))
        if len(self.maps) != 1:
            return view({"maps": ""}, maps=self.maps, notes=notes)
        (loaded,) = self.maps
        contents = (
            f"{counted(loaded.missions, 'mission')}, "
            f"{counted(loaded.vertices, 'vertex', 'vertices')}, "
            f"{counted(loaded.landmarks, 'landmark')}"
        )
        sentence = f"map '{loaded.map_key}': {contents}, from {loaded.folder}"
        return Message("\n".join((sentence, *notes)))


class MergedMaps(Report):
    """Maps loaded and merged into one."""

    map_key: str
    missions: int
    vertices: int
    landmarks: int
    merged_folders: tuple[str, ...]
    details: tuple[Report, ...]

    def display(self) -> Any:
        """Return the result without what every single merge added."""
        notes = (note for report in self.details for note in getattr(report, "notes", ()))
        values = vars(self) | {"merged_folders": len(self.merged_folders)}
        del values["details"]
        return view(**values, notes=tuple(dict.fromkeys(notes)))


class ReadingOptions(CacheOptions, SizeOptions):
    """Reading of map files."""

    repair: bool = False
    """Keep the observations that both of their copies agree on and drop what is no number instead of refusing
    the map."""


@command(
    "list_maps_on_file_system",
    example="list_maps_on_file_system maps",
    needs_map=False,
    reads=("maps_folder",),
)
def list_maps_on_file_system(_: CommandContext, maps_folder: Path) -> FolderList:
    """List the map folders below a folder."""
    return FolderList(maps_folder, tuple(str(p) for p in _folders_below(maps_folder)))


@command("load", example="load --map_folder=maps/v1_01", needs_map=False, reads=("map_folder",))
def load(
    context: CommandContext,
    map_folder: Path,
    *,
    map_key: str = "",
    assign_new_ids: bool = False,
    reading: ReadingOptions = ReadingOptions(),
) -> LoadedMaps:
    """Load a map into memory and select it.

    Args:
        map_folder: Folder of the map.
        map_key: Key of the map in memory; empty = the folder's name.
        assign_new_ids: Give missions, vertices, landmarks and edges new ids.
    """
    from maplab_py.storage import mission_names, native
    from maplab_py.vimap.edits import with_new_ids

    key = context.maps.check_new_key(map_key or key_of_folder(map_folder))
    before = native.disk_copy(map_folder)
    vi_map, report = native.load_map(
        map_folder,
        max_size_megabytes=reading.proto_max_size_megabytes,
        repair=reading.repair,
        progress=context.progress,
        cache=_cache(reading),
    )
    vi_map = mission_names.with_folder_names(vi_map, map_folder)
    if assign_new_ids:
        vi_map = with_new_ids(vi_map)
    is_saved = not (assign_new_ids or reading.repair)
    context.maps.add(key, vi_map, folder=map_folder, is_saved=is_saved, disk_copy=before)
    return LoadedMaps((_describe(key, vi_map, map_folder),), (report,))


@command("recover", needs_map=False, see_also=("load", "save"))
def recover(context: CommandContext, run: str = "") -> LoadedMaps:
    """Load the maps that the latest failed script left unsaved; save them where they shall stay.

    The maps of the last five such scripts are kept.

    Args:
        run: Name of an earlier script's folder, as the error said; empty = the latest.
    """
    from maplab_py.console.scripts.recovery import rescue_folder, rescued_runs
    from maplab_py.storage.native import find_maps, load_map

    runs = [path for path in rescued_runs() if run in ("", path.name, str(path))]
    if not runs:
        wanted = f"no script '{run}'" if run else "no script"
        raise UserError(f"recover: {wanted} has left unsaved maps in {rescue_folder()}")
    maps, reports = [], []
    for folder in find_maps(runs[-1]):
        vi_map, report = load_map(folder, progress=context.progress)
        key = context.maps.check_new_key(folder.name)
        context.maps.add(key, vi_map, is_saved=False)
        maps.append(_describe(key, vi_map, folder))
        reports.append(report)
    return LoadedMaps(tuple(maps), tuple(reports))


@command("load_all", example="load_all --maps_folder=maps", needs_map=False, reads=("maps_folder",))
def load_all(
    context: CommandContext,
    maps_folder: Path,
    *,
    assign_new_ids: bool = False,
    reading: ReadingOptions = ReadingOptions(),
) -> LoadedMaps:
    """Load every map below a folder, each under the name of its folder; the last is selected.

    Args:
        assign_new_ids: Give missions, vertices, landmarks and edges new ids.
    """
    from maplab_py.storage.native import disk_copy
    from maplab_py.vimap.edits import with_new_ids

    folders = _folders_below(maps_folder)
    keys = [context.maps.check_new_key(key_of_folder(folder)) for folder in folders]
    twice = sorted({key for key in keys if keys.count(key) > 1})
    if twice:
        raise UserError(
            f"load_all: two folders would get the map key '{twice[0]}'; load them one by one"
        )
    before = [disk_copy(folder) for folder in folders]
    loaded = _load_each(context, folders, reading)
    is_saved = not (assign_new_ids or reading.repair)
    lines = []
    for key, copy, folder, (vi_map, _) in zip(keys, before, folders, loaded, strict=True):
        value = with_new_ids(vi_map) if assign_new_ids else vi_map
        context.maps.add(key, value, folder=folder, is_saved=is_saved, disk_copy=copy)
        lines.append(_describe(key, value, folder))
    return LoadedMaps(tuple(lines), ())


@command(
    "load_merge_map",
    example="load_merge_map --map_folder=maps/v1_02",
    needs_map=False,
    reads=("map_folder",),
)
def load_merge_map(
    context: CommandContext,
    map_folder: Path,
    *,
    assign_new_ids: bool = False,
    reading: ReadingOptions = ReadingOptions(),
) -> MergedMaps:
    """Load a map and merge its missions into the selected map.

    Without a selected map it is loaded as a new map.

    Args:
        map_folder: Folder of the map.
        assign_new_ids: Give the loaded missions, vertices, landmarks and edges new ids.
    """
    key = _target_key(context, map_folder, "")
    return _merge_all(context, [map_folder], key, reading, assign_new_ids=assign_new_ids)


@command(
    "load_merge_all_maps",
    example="load_merge_all_maps --maps_folder=maps",
    needs_map=False,
    reads=("maps_folder",),
)
def load_merge_all_maps(
    context: CommandContext,
    maps_folder: Path,
    *,
    target_map_key: str = "",
    assign_new_ids: bool = False,
    reading: ReadingOptions = ReadingOptions(),
) -> MergedMaps:
    """Load every map below a folder and merge all missions into the selected map or a new one.

    Args:
        target_map_key: Key of a new map for the result; empty = the selected map, or if there is
            none a new map named after the folder.
        assign_new_ids: Give the loaded missions, vertices, landmarks and edges new ids, so that
            one recording can serve as several.
    """
    key = _target_key(context, maps_folder, target_map_key)
    folders = _folders_below(maps_folder)
    return _merge_all(context, folders, key, reading, assign_new_ids=assign_new_ids)


@command(
    "load_merge_submap",
    example="load_merge_submap --map_folder=submap_1",
    needs_map=False,
    reads=("map_folder",),
)
def load_merge_submap(
    context: CommandContext,
    map_folder: Path,
    *,
    assign_new_ids: bool = False,
    reading: ReadingOptions = ReadingOptions(),
) -> MergedMaps:
    """Load a part of a mission and append it to that mission in the selected map.

    Without a selected map the part is loaded as a new map.

    Args:
        map_folder: Folder of the submap.
        assign_new_ids: Give the part new ids: it becomes a separate mission.
    """
    key = _target_key(context, map_folder, "")
    if assign_new_ids:
        return _merge_all(context, [map_folder], key, reading, assign_new_ids=True)
    return _append_all(context, [map_folder], key, reading, assign_new_ids=False)


@command(
    "load_merge_all_submaps",
    example="load_merge_all_submaps --maps_folder=euroc_v1_01",
    needs_map=False,
    reads=("maps_folder",),
)
def load_merge_all_submaps(
    context: CommandContext,
    maps_folder: Path,
    *,
    target_map_key: str = "",
    assign_new_ids: bool = False,
    reading: ReadingOptions = ReadingOptions(),
) -> MergedMaps:
    """Load the parts of missions below a folder in time order and join them.

    Args:
        target_map_key: Key of a new map for the result; empty = the selected map, or if there is
            none a new map named after the folder.
        assign_new_ids: Give the joined missions, vertices, landmarks and edges new ids.
    """
    key = _target_key(context, maps_folder, target_map_key)
    folders = _folders_below(maps_folder)
    return _append_all(context, folders, key, reading, assign_new_ids=assign_new_ids)


def _merge_all(
    context: CommandContext,
    folders: list[Path],
    new_key: str,
    reading: ReadingOptions,
    *,
    assign_new_ids: bool,
) -> MergedMaps:
    """Load folders and merge them into the selected map, or into a new one if a key is given."""
    from maplab_py.vimap import edits, merge

    loaded = _load_each(context, folders, reading)
    base = None if new_key else context.vi_map
    details: list[Report] = []
    for (vi_map, _), folder in zip(loaded, folders, strict=True):
        context.progress.check()
        if base is None:
            base = merge.without_folder(vi_map, folder)
            base = edits.with_new_ids(base) if assign_new_ids else base
            continue
        other = merge.at_folder(vi_map, folder)
        base, report = merge.merge_maps(base, other, assign_new_ids=assign_new_ids)
        details.append(report)
    return _hand_over(context, base, new_key, folders, details)


def _append_all(
    context: CommandContext,
    folders: list[Path],
    new_key: str,
    reading: ReadingOptions,
    *,
    assign_new_ids: bool,
) -> MergedMaps:
    """Load folders in time order and append each to its mission; the first part starts it."""
    from maplab_py.vimap.edits import with_new_ids
    from maplab_py.vimap.merge import merge_maps, without_folder
    from maplab_py.vimap.submaps import append_submap

    loaded = _load_each(context, folders, reading)
    located = (
        without_folder(vi_map, folder) for (vi_map, _), folder in zip(loaded, folders, strict=True)
    )
    pieces = sorted(located, key=_start_time_ns)
    selected = None if new_key else context.vi_map
    base = None if assign_new_ids else selected
    details: list[Report] = []
    for piece in pieces:
        context.progress.check()
        if base is None:
            base = piece
            continue
        joins = bool((base.mission_index.rows(piece.missions.id) >= 0).any())
        base, report = append_submap(base, piece) if joins else merge_maps(base, piece)
        details.append(report)
    if base is not None and assign_new_ids:
        if selected is None:
            base = with_new_ids(base)
        else:
            base, merge_report = merge_maps(selected, base, assign_new_ids=True)
            details.append(merge_report)
    return _hand_over(context, base, new_key, folders, details)


def _hand_over(
    context: CommandContext,
    vi_map: VIMap | None,
    new_key: str,
    folders: list[Path],
    details: list[Report],
) -> MergedMaps:
    if vi_map is None:
        raise UserError("there is nothing to merge")
    if new_key:
        context.maps.add(new_key, vi_map)
    else:
        context.commit(vi_map)
    return MergedMaps(
        context.map_key,
        len(vi_map.missions),
        len(vi_map.vertices),
        len(vi_map.landmarks),
        tuple(str(folder) for folder in folders),
        tuple(details),
    )


def _target_key(context: CommandContext, folder: Path, target_map_key: str) -> str:
    """Return the key of the new map for the result, empty for the selected map."""
    if target_map_key == "" and context.maps.selected_key:
        return ""
    return context.maps.check_new_key(target_map_key or key_of_folder(folder))


def _cache(reading: ReadingOptions) -> MapCache | None:
    """Return the cache of maps if it is asked for."""
    from maplab_py.storage.native import MapCache

    return MapCache(reading.map_cache_max_gb) if reading.map_cache else None


def _load_each(
    context: CommandContext, folders: list[Path], reading: ReadingOptions
) -> list[tuple[VIMap, Report]]:
    from maplab_py.storage.mission_names import with_folder_names
    from maplab_py.storage.native import load_map

    loaded: list[tuple[VIMap, Report]] = []
    for done, folder in enumerate(folders):
        context.progress.step(done, len(folders), f"load {folder.name}")
        limit, repair = reading.proto_max_size_megabytes, reading.repair
        vi_map, report = load_map(
            folder, max_size_megabytes=limit, repair=repair, cache=_cache(reading)
        )
        loaded.append((with_folder_names(vi_map, folder), report))
    return loaded


def _folders_below(maps_folder: Path) -> list[Path]:
    from maplab_py.storage.native import find_maps

    if not maps_folder.is_dir():
        raise UserError(f"--maps_folder={maps_folder}: there is no such folder")
    folders = find_maps(maps_folder)
    if not folders:
        raise UserError(f"--maps_folder={maps_folder}: there is no map in it or below it")
    return folders


def _start_time_ns(vi_map: VIMap) -> int:
    return int(vi_map.vertices.timestamp_ns.min()) if len(vi_map.vertices) else 0


def _describe(key: str, vi_map: VIMap, folder: Path) -> LoadedMap:
    counts = len(vi_map.missions), len(vi_map.vertices), len(vi_map.landmarks)
    return LoadedMap(key, *counts, folder)
