"""A side file with the checksum of every file of a map; C++ maplab ignores it."""

from __future__ import annotations

import hashlib
from pathlib import Path

from maplab_py.errors import MapError

FILE_NAME = "checksums.sha256"


def write(folder: Path) -> None:
    """Write the checksums of all files below a folder, resources left out."""
    lines = []
    for path in sorted(folder.rglob("*")):
        relative = path.relative_to(folder)
        if path.is_file() and relative.parts[0] != "resources" and path.name != FILE_NAME:
            lines.append(f"{_digest(path)}  {relative.as_posix()}\n")
    (folder / FILE_NAME).write_text("".join(lines), encoding="utf-8")


def verify(folder: Path) -> None:
    """Compare all files with the side file, if there is one.

    Raises:
        MapError: A file is missing or has changed; the message names it.
    """
    side_file = folder / FILE_NAME
    if not side_file.is_file():
        return
    for line in side_file.read_text(encoding="utf-8", errors="replace").splitlines():
        digest, _, name = line.partition("  ")
        path = folder / name
        if not name or ".." in Path(name).parts or Path(name).is_absolute():
            raise MapError(f"{side_file}: is damaged; delete it to load without checksums")
        if not path.is_file():
            raise MapError(f"{path}: is missing")
        if _digest(path) != digest:
            raise MapError(
                f"{path}: is damaged: it does not have its checksum "
                f"(delete {FILE_NAME} to load it all the same)"
            )


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
