"""Reports of imports and exports of resources."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from maplab_py.report import Report


@dataclasses.dataclass(frozen=True)
class ImportedResources(Report):
    """Files that became resources of a mission; they are written when the map is saved."""

    mission: str
    resource_types: tuple[str, ...]
    files_in_folder: int
    attached: int
    frames_that_had_some: int = dataclasses.field(
        default=0, metadata={"title": "frames with a resource before"}
    )
    frames_without_file: int = 0
    notes: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class ExportedImages(Report):
    """Images that were written as an EuRoC folder."""

    folder: Path
    images: int
    cameras: int
