"""Save a map folder: lossless, as C++ maplab writes it, and atomically."""

import gzip
import os
import shutil
import time
from collections.abc import Sequence
from pathlib import Path

from google.protobuf import text_format
from google.protobuf.message import Message

from maplab_py.atomic import link_or_copy, recover, replaced_folder
from maplab_py.cancellation import check_cancelled
from maplab_py.errors import UserError, os_errors_as
from maplab_py.progress import SILENT, Progress
from maplab_py.report import Report
from maplab_py.sensors import CameraRig, Distortion, sensors_yaml
from maplab_py.sensors.camera import is_known_to_maplab
from maplab_py.storage import checksums, mission_names
from maplab_py.storage import maplab_map_pb2 as pb
from maplab_py.storage.load_checks import check_loadable
from maplab_py.storage.protobuf import map_files, tables_to_messages
from maplab_py.storage.protobuf.descriptor_layout import LayoutChoice, with_layout
from maplab_py.storage.resources.new import copied_files, with_staged_in_place
from maplab_py.storage.unchanged_files import TakenOver, WrittenFiles
from maplab_py.vimap import VIMap, number_repair

RESOURCES = "resources"
CARD_FILE = "card.html"
"""The origin of a map, which a session writes; another map must not keep it."""
_GZIP_LEVEL = 1


class SaveReport(Report):
    """Result of saving a map."""

    folder: str
    files: int
    megabytes: float  # on disk, resources left out
    fingerprint: str  # of the files; equal maps have equal ones
    seconds: float
    notes: tuple[str, ...] = ()  # what was repaired


def save_map(
    vi_map: VIMap,
    folder: Path,
    *,
    overwrite: bool = False,
    known: str = "",
    force: bool = False,
    compress: bool = True,
    descriptor_layout: LayoutChoice = "as_loaded",
    resource_files: Sequence[tuple[Path, Path]] = (),
    written: WrittenFiles | None = None,
    repair: bool = False,
    progress: Progress = SILENT,
) -> SaveReport:
    """Save a map atomically: the folder always holds the complete old or the complete new map.

    Other files in the folder, such as resources, are kept. Staged resources are copied to the
    folder that the map uses for new resources.

    Args:
        folder: Map folder; made with its parents when it does not exist.
        overwrite: Replace a map that is there.
        known: Fingerprint of the map that is there as the caller knows it (see
            `checksums.fingerprint`): that one is replaced without `overwrite`, and another one
            only by `force`.
        force: Replace any existing map.
        compress: Compress the gzip files, as maplab does; else their content is stored in them as it is,
            which takes a tenth of the time and about twice the room. maplab reads both.
        descriptor_layout: Layout of the descriptors; "as_loaded" writes every frame in the layout
            that it was loaded with and new frames in that of maplab 2.2.
        resource_files: Files that come into the map's own resource folder, with their paths in it.
        written: What the folder had after its last save, and where it is noted for the next one:
            files that would not change are taken over, in a partition of its own.
        repair: Drop what is no number instead of refusing it; see `number_repair`.

    Raises:
        MapError: The map violates a rule without which it could not be loaded.
        UserError: The folder holds a map that must not be replaced, or something else than a map,
            or it cannot be written; or the layout cannot hold the descriptors.
    """
    began = time.perf_counter()
    vi_map, notes = number_repair.without_bad_numbers(vi_map) if repair else (vi_map, [])
    check_loadable(vi_map, folder)
    resources = with_staged_in_place(with_layout(vi_map, descriptor_layout))
    folder = Path(folder).absolute()
    recover(folder)
    check_target(folder, overwrite=overwrite, known=known, force=force)
    on_disk: set[Path] = set()
    with copied_files(resources.to_external), replaced_folder(folder, on_disk) as temporary:
        check_target(folder, overwrite=overwrite, known=known, force=force)
        taken = TakenOver(written, temporary, compress=compress) if written else None
        files, listed = _write(resources.vi_map, temporary, compress, taken, progress)
        size = sum(path.stat().st_size for path in temporary.rglob("*") if path.is_file())
        on_disk |= taken.linked if taken else set()
        _keep(folder, temporary, on_disk)
        _add_resources((*resource_files, *resources.into_map), temporary)
    if taken is not None:
        taken.finish(folder, listed)
    for line in _unknown_models(vi_map):
        progress.line(line)
    seconds = time.perf_counter() - began
    return SaveReport(
        str(folder), files, size / 1e6, checksums.fingerprint_of(listed), seconds, tuple(notes)
    )


def _unknown_models(vi_map: VIMap) -> list[str]:
    """Return a line for each camera model that C++ maplab does not know."""
    rigs = [sensor for sensor in vi_map.sensors.sensors.values() if isinstance(sensor, CameraRig)]
    models = {(camera.projection, camera.distortion) for rig in rigs for camera in rig.cameras}
    return sorted(
        f"C++ maplab cannot load this map: it does not know the camera model {projection.value}"
        + ("" if distortion is Distortion.NONE else f" with {distortion.value} distortion")
        for projection, distortion in models
        if not is_known_to_maplab(projection, distortion)
    )


def check_target(
    folder: Path,
    *,
    overwrite: bool = False,
    known: str = "",
    force: bool = False,
    flag: str = "overwrite",
) -> None:
    """Check that a map may be saved to a folder; see `save_map`.

    Args:
        overwrite: See `save_map`.
        known: See `save_map`.
        force: See `save_map`.
        flag: Name of the flag that permits to replace a map, for the message.

    Raises:
        UserError: It holds a map that must not be replaced, or something else than a map.
    """
    with os_errors_as(UserError, f"{folder}: cannot be read"):
        if not folder.exists():
            return
        if not folder.is_dir():
            raise UserError(f"{folder} is not a folder; give a folder")
        if not map_files.is_map_folder(folder):
            if any(folder.iterdir()):
                raise UserError(f"{folder} is not empty and not a map; choose another folder")
        elif force:
            return
        elif known and checksums.fingerprint(folder) != known:
            raise UserError(
                f"{folder} has been changed by another program since this map was loaded or saved; "
                "save to another --map_folder, or give --force to replace it"
            )
        elif not known and not overwrite:
            raise UserError(f"{folder} holds a map already; use --{flag} to replace it")


def check_parent(folder: Path) -> None:
    """Check that a folder can be made or replaced: the nearest folder above it that exists is writable.

    Raises:
        UserError: It is not, or it is no folder.
    """
    above = folder.absolute().parent
    while not os.path.lexists(above):
        above = above.parent
    if not above.is_dir():
        raise UserError(f"{folder} cannot be saved: {above} is not a folder; choose another folder")
    if not os.access(above, os.W_OK | os.X_OK):
        raise UserError(f"{folder} cannot be saved: {above} is not writable; choose another folder")


def _write(
    vi_map: VIMap, folder: Path, compress: bool, taken: TakenOver | None, progress: Progress
) -> tuple[int, str]:
    """Return the number of files and their checksums."""
    inner = folder / map_files.VI_MAP_FOLDER
    inner.mkdir()
    listing = pb.VIMapMetadata()
    _write_message(inner / map_files.MISSIONS, tables_to_messages.missions(vi_map), compress)
    listing.files.add(file_type=map_files.FileKind.MISSIONS, path=map_files.MISSIONS)
    partition = taken.partition if taken else tables_to_messages.Partition()
    for content in tables_to_messages.contents(vi_map, partition):
        check_cancelled()
        progress.step(len(listing.files), len(vi_map.vertices) // 50 + 4, "write files")
        if taken is None or not taken.take_over(
            content, f"{map_files.VI_MAP_FOLDER}/{content.name}"
        ):
            _write_bytes(inner / content.name, content.data(), compress)
        listing.files.add(file_type=content.kind, path=content.name)
    _write_text(inner / map_files.VI_MAP_METADATA, text_format.MessageToString(listing))
    _write_text(inner / map_files.SENSORS, sensors_yaml.write_sensors(vi_map.sensors))
    _write_message(
        folder / map_files.RESOURCE_INFO, tables_to_messages.resource_info(vi_map), compress
    )
    metadata = pb.MetaData(
        map_folder=vi_map.metadata.map_folder or ".",
        map_description=vi_map.metadata.description,
        resource_folder_in_use=vi_map.metadata.resource_folder_in_use,
        map_resource_folder=vi_map.metadata.map_resource_folder,
        external_resource_folders=vi_map.metadata.external_resource_folders,
    )
    _write_text(folder / map_files.METADATA, text_format.MessageToString(metadata))
    names = mission_names.text_of_names(vi_map)
    if names:
        _write_text(folder / mission_names.FILE_NAME, names)
    return len(listing.files), checksums.write(folder, taken.checksums if taken else None)


def _write_message(path: Path, message: Message, compress: bool) -> None:
    _write_bytes(path, message.SerializeToString(deterministic=True), compress)


def _write_bytes(path: Path, data: bytes, compress: bool) -> None:
    path.write_bytes(gzip.compress(data, _GZIP_LEVEL if compress else 0, mtime=0))


def _write_text(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")


def _keep(old: Path, new: Path, linked: set[Path]) -> None:
    """Link the files of the old folder that do not belong to its map into the new one, and note the links."""
    if not old.is_dir():
        return
    for entry in os.scandir(old):
        belongs = entry.name in (checksums.FILE_NAME, mission_names.FILE_NAME, CARD_FILE)
        if not belongs and not (new / entry.name).exists():
            _bring(entry, new / entry.name, linked)


def _bring(entry: os.DirEntry[str], target: Path, linked: set[Path]) -> None:
    """Link a file or folder (copy it where links do not work); symbolic links stay what they are."""
    if entry.is_symlink():
        target.symlink_to(os.readlink(entry.path))
    elif entry.is_dir():
        target.mkdir()
        shutil.copystat(entry.path, target)
        for inner in os.scandir(entry.path):
            _bring(inner, target / inner.name, linked)
    elif link_or_copy(entry.path, target):
        linked.add(target)


def _add_resources(files: Sequence[tuple[Path, Path]], new: Path) -> None:
    for source, relative in files:
        target = new / RESOURCES / relative
        if target.exists() or target.is_symlink():
            continue
        target.parent.mkdir(parents=True, exist_ok=True)
        if source.is_symlink():
            target.symlink_to(os.readlink(source))
        else:
            link_or_copy(source, target)
