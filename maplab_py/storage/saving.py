"""Save a map folder: lossless, as C++ maplab writes it, and atomically."""

from __future__ import annotations

import dataclasses
import gzip
import os
import shutil
import time
from collections.abc import Sequence
from pathlib import Path

from google.protobuf import text_format
from google.protobuf.message import Message

from maplab_py.errors import UserError
from maplab_py.progress import SILENT, Progress
from maplab_py.report import Report
from maplab_py.sensors.sensors_yaml import write_sensors
from maplab_py.storage import checksums, writing
from maplab_py.storage import maplab_map_pb2 as pb
from maplab_py.storage.atomic import recover, replaced_folder
from maplab_py.storage.files import (
    METADATA,
    RESOURCE_INFO,
    SENSORS,
    VI_MAP_FOLDER,
    VI_MAP_METADATA,
    is_map_folder,
)
from maplab_py.vimap import VIMap

RESOURCES = "resources"
_GZIP_LEVEL = 1


@dataclasses.dataclass(frozen=True)
class SaveReport(Report):
    """What was saved."""

    folder: str
    files: int
    megabytes: float  # on disk, resources left out
    seconds: float


def save_map(
    vi_map: VIMap,
    folder: Path,
    *,
    overwrite: bool = False,
    compress: bool = True,
    resource_files: Sequence[tuple[Path, Path]] = (),
    progress: Progress = SILENT,
) -> SaveReport:
    """Save a map; the folder holds the old map or the new one, whatever happens meanwhile.

    Resource files that are in the folder stay in it.

    Args:
        vi_map: Map.
        folder: Map folder; made with its parents when it does not exist.
        overwrite: Replace a map that is there.
        compress: Write gzip files, as maplab does.
        resource_files: Files that come into the map's own resource folder, with their paths in it.
        progress: Shown while writing.

    Raises:
        UserError: The folder holds a map and overwrite is off, or something else than a map, or
            it cannot be written.
    """
    began = time.perf_counter()
    folder = Path(folder).absolute()
    recover(folder)
    _check_target(folder, overwrite)
    try:
        with replaced_folder(folder) as temporary:
            files = _write(vi_map, temporary, compress, progress)
            _keep_resources(folder, temporary)
            _add_resources(resource_files, temporary)
    except OSError as error:
        raise UserError(f"{folder}: cannot be saved ({error.strerror})") from error
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    return SaveReport(str(folder), files, size / 1e6, time.perf_counter() - began)


def _check_target(folder: Path, overwrite: bool) -> None:
    if not folder.exists():
        return
    if not folder.is_dir():
        raise UserError(f"{folder} is a file; give a folder")
    if is_map_folder(folder):
        if not overwrite:
            raise UserError(f"{folder} holds a map already; use --overwrite to replace it")
    elif any(folder.iterdir()):
        raise UserError(f"{folder} is not empty and not a map; choose another folder")


def _write(vi_map: VIMap, folder: Path, compress: bool, progress: Progress) -> int:
    inner = folder / VI_MAP_FOLDER
    inner.mkdir()
    listing = pb.VIMapMetadata()
    for kind, name, message in writing.messages(vi_map):
        progress.step(len(listing.files), len(vi_map.vertices) // 50 + 4, "write files")
        _write_message(inner / name, message, compress)
        listing.files.add(file_type=kind, path=name)
    _write_text(inner / VI_MAP_METADATA, text_format.MessageToString(listing))
    _write_text(inner / SENSORS, write_sensors(vi_map.sensors))
    _write_message(folder / RESOURCE_INFO, writing.resource_info(vi_map), compress)
    metadata = pb.MetaData(
        map_folder=vi_map.metadata.map_folder or ".",
        map_description=vi_map.metadata.description,
        resource_folder_in_use=vi_map.metadata.resource_folder_in_use,
        map_resource_folder=vi_map.metadata.map_resource_folder,
        external_resource_folders=vi_map.metadata.external_resource_folders,
    )
    _write_text(folder / METADATA, text_format.MessageToString(metadata))
    checksums.write(folder)
    return len(listing.files)


def _write_message(path: Path, message: Message, compress: bool) -> None:
    data = message.SerializeToString(deterministic=True)
    path.write_bytes(gzip.compress(data, _GZIP_LEVEL, mtime=0) if compress else data)


def _write_text(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")


def _keep_resources(old: Path, new: Path) -> None:
    """Link (or copy, where links do not work) the resource files of the old folder into the new."""
    source = old / RESOURCES
    if source.is_dir():
        shutil.copytree(source, new / RESOURCES, copy_function=_link_or_copy)


def _add_resources(files: Sequence[tuple[Path, Path]], new: Path) -> None:
    for source, relative in files:
        target = new / RESOURCES / relative
        if not target.exists():
            target.parent.mkdir(parents=True, exist_ok=True)
            _link_or_copy(str(source), str(target))


def _link_or_copy(source: str, target: str) -> str:
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)
    return target
