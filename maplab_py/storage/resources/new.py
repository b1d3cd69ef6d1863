"""New resources of a map: staged in a temporary folder until the map is saved."""

import contextlib
import dataclasses
import hashlib
import os
import shutil
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from maplab_py.array_types import U8
from maplab_py.atomic import replaced_file
from maplab_py.atomic.files import make_folders, remove_folders
from maplab_py.cancellation import check_cancelled, cleaned_up, lasting_effect, provisional_effects
from maplab_py.storage.resources.store import MAP_FOLDER, relative_path
from maplab_py.storage.resources.types import resource_type
from maplab_py.vimap import IdArray, ResourceOwner, Resources, VIMap, staged_folder, to_hex

RAW_IMAGES = 0
"""Number of the resource type of grey images as recorded."""

CopiedFile = tuple[Path, Path]
"""A file, and where it goes."""


class NewResources:
    """Resource files that are written before the map that refers to them is saved.

    Undo and failed saves leave nothing behind: the files lie in a temporary folder, which exists
    as long as this object or a map refers to it. `save_map` copies them into the resource folder
    that the map uses for new resources.
    """

    def __init__(self, parent: Path | None = None, *, seed: bytes = b"") -> None:
        """Start without files.

        Args:
            parent: Folder that gets the temporary folder; None = the system's.
            seed: Ids follow from it and from the contents, so that equal input gives equal ids.

        Raises:
            UserError: The temporary folder cannot be made.
        """
        self._folder, self._seed = staged_folder.StagedFolder(parent), seed
        self._ids: list[IdArray] = []
        self._types: list[int] = []

    def __len__(self) -> int:
        return len(self._ids)

    @property
    def type_names(self) -> tuple[str, ...]:
        """Names of the types of the resources that were added, sorted."""
        return tuple(sorted({resource_type(kind).name for kind in self._types}))

    def add(self, kind: int, content: bytes) -> int:
        """Write a file of a resource type (number); return its row for `attached`.

        Raises:
            MapError: The format has no such type.
            UserError: The file cannot be written.
        """
        resource_id, relative = self._named(kind, content)
        self._folder.write(relative, [content])
        return self._noted(resource_id, kind)

    def add_link(self, kind: int, content: bytes, file: Path) -> int:
        """Refer to a file outside by a symbolic link instead of writing its content; see `add`."""
        resource_id, relative = self._named(kind, content)
        self._folder.link(relative, file)
        return self._noted(resource_id, kind)

    def add_image(self, image: U8, kind: int = RAW_IMAGES) -> int:
        """Write an image (H, W) grey or (H, W, 3) BGR; see `add`."""
        import cv2

        _, encoded = cv2.imencode(resource_type(kind).suffix, image)
        return self.add(kind, encoded.tobytes())

    def _named(self, kind: int, content: bytes) -> tuple[IdArray, Path]:
        """Return the id and the relative path of a new resource."""
        described = resource_type(kind)
        key = b"%d %d " % (kind, len(self)) + self._seed
        digest = hashlib.blake2b(content, digest_size=16, key=hashlib.sha256(key).digest()).digest()
        resource_id = np.frombuffer(digest, dtype=np.uint64)
        return resource_id, Path(described.name) / f"{to_hex(resource_id)}{described.suffix}"

    def _noted(self, resource_id: IdArray, kind: int) -> int:
        self._ids.append(resource_id)
        self._types.append(kind)
        return len(self) - 1

    def attached(
        self,
        vi_map: VIMap,
        rows: ArrayLike,
        owner: ArrayLike,
        owner_kind: ResourceOwner = ResourceOwner.FRAME,
        *,
        sensor_id: ArrayLike | None = None,
        timestamp_ns: ArrayLike | None = None,
    ) -> VIMap:
        """Return the map with new resources.

        Args:
            rows: Resources (N,), as `add` returned them.
            owner: Owners (N,): rows of frames, or of missions for missions and sensors.
            owner_kind: What owns them.
            sensor_id: Sensor (2,) of resources that a sensor owns.
            timestamp_ns: Their times (N,).
        """
        chosen = np.asarray(rows, dtype=np.int64)
        metadata = vi_map.metadata
        name = str(self._folder.path)
        folders = metadata.external_resource_folders
        if name not in folders:
            folders = (*folders, name)
            metadata = dataclasses.replace(
                metadata,
                external_resource_folders=folders,
                staged_folders=(*metadata.staged_folders, self._folder),
            )
        table = Resources.filled(
            len(chosen),
            id=np.array(self._ids, dtype=np.uint64).reshape(-1, 2)[chosen],
            type=np.array(self._types, dtype=np.int32)[chosen],
            owner_kind=np.full(len(chosen), owner_kind),
            owner=owner,
            folder=np.full(len(chosen), folders.index(name)),
        )
        if sensor_id is not None:
            table = table.replace(
                sensor_id=np.tile(np.asarray(sensor_id, dtype=np.uint64), (len(chosen), 1)),
                timestamp_ns=np.asarray(timestamp_ns, dtype=np.int64),
            )
        return vi_map.replace(
            resources=Resources.concatenate([vi_map.resources, table]), metadata=metadata
        )


@dataclasses.dataclass(frozen=True, eq=False)
class SavedResources:
    """A map as it is written, and the staged files that must be copied for it."""

    vi_map: VIMap  # refers to no staged folder
    into_map: tuple[CopiedFile, ...]  # targets are relative to the map's resource folder
    to_external: tuple[CopiedFile, ...]  # absolute targets


def with_staged_in_place(vi_map: VIMap) -> SavedResources:
    """Assign staged resources to the folder that the map uses for new ones."""
    metadata, table = vi_map.metadata, vi_map.resources
    if not metadata.staged_folders:
        return SavedResources(vi_map, (), ())
    folders = metadata.external_resource_folders
    staged = [str(folder.path) for folder in metadata.staged_folders]
    kept = tuple(name for name in folders if name not in staged)
    in_use = metadata.resource_folder_in_use
    used = folders[in_use] if 0 <= in_use < len(folders) and folders[in_use] in kept else ""
    target = kept.index(used) if used else MAP_FOLDER
    place = [kept.index(name) if name in kept else target for name in folders]
    files: dict[Path, Path] = {}
    for index, name in enumerate(folders):
        if name in staged:
            for row in np.flatnonzero(table.folder == index).tolist():
                relative = relative_path(vi_map, row)
                files[Path(used) / relative if used else relative] = Path(name) / relative
    copied = tuple((source, copy) for copy, source in sorted(files.items()))
    known = np.array([*place, MAP_FOLDER], dtype=np.int32)
    saved = vi_map.replace(
        resources=table.replace(folder=known[table.folder]),
        metadata=dataclasses.replace(
            metadata,
            resource_folder_in_use=target,
            external_resource_folders=kept,
            staged_folders=(),
        ),
    )
    return SavedResources(saved, () if used else copied, copied if used else ())


@contextlib.contextmanager
def copied_files(files: Sequence[CopiedFile]) -> Iterator[None]:
    """Copy files that do not exist yet; delete the copies if the block fails or is cancelled.

    Raises:
        UserError: A file cannot be written.
    """
    copies: list[Path] = []
    folders: list[Path] = []
    is_kept = False

    def remove() -> None:
        if not is_kept:
            _delete(copies)
            remove_folders(folders)

    with cleaned_up(remove):
        for source, target in files:
            check_cancelled()
            if target.exists() or target.is_symlink():
                continue
            folders += make_folders(target.parent)
            if source.is_symlink():
                with provisional_effects(), lasting_effect():
                    target.symlink_to(os.readlink(source))
                copies.append(target)
                continue
            with provisional_effects(), replaced_file(target) as copy, source.open("rb") as content:
                shutil.copyfileobj(content, copy)
            copies.append(target)
        yield
        is_kept = True


def _delete(files: Iterable[Path]) -> None:
    for file in files:
        with contextlib.suppress(OSError):
            file.unlink()
