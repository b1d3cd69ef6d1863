"""A side file with the checksum of every file of a map; C++ maplab ignores it."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

from maplab_py.errors import MapError
from maplab_py.input_files import read_text
from maplab_py.storage.map_files import METADATA, RESOURCE_INFO, VI_MAP_FOLDER

FILE_NAME = "checksums.sha256"
_FINGERPRINT_DIGITS = 16
_DIGEST = re.compile(r"[0-9a-f]{64}")
_MAX_BYTES = 16_000_000
"""Largest size of the side file: enough for a hundred thousand files."""


def write(folder: Path) -> str:
    """Write the checksums of a map's files, without resources, and return the fingerprint."""
    listing = _listing(folder)
    (folder / FILE_NAME).write_text(listing, encoding="utf-8")
    return _digits(listing)


def fingerprint(folder: Path) -> str:
    """Return a hexadecimal hash of a map's files, without resources.

    Raises:
        OSError: A file cannot be read.
    """
    return _digits(_listing(folder))


def verify(folder: Path) -> None:
    """Compare all files with the side file, if there is one.

    Raises:
        MapError: A file is missing or has changed; the message names it.
    """
    side_file = folder / FILE_NAME
    if not side_file.is_file():
        return
    without = "delete it to load without checksums"
    try:
        text = read_text(side_file, _MAX_BYTES, remedy=without, error=MapError)
    except UnicodeDecodeError:
        raise MapError(f"{side_file}: is damaged: it is not text; {without}") from None
    for number, line in enumerate(text.splitlines(), start=1):
        digest, _, name = line.partition("  ")
        path = folder / name
        is_inside = name and ".." not in Path(name).parts and not Path(name).is_absolute()
        if not is_inside or not _DIGEST.fullmatch(digest) or "\0" in name:
            raise MapError(f"{side_file}: line {number} is damaged; {without}")
        if not path.is_file():
            raise MapError(f"{path}: is missing")
        if _digest(path) != digest:
            raise MapError(
                f"{path}: is damaged: it does not have its checksum "
                f"(delete {FILE_NAME} to load it without the check)"
            )


def _digits(listing: str) -> str:
    return hashlib.sha256(listing.encode()).hexdigest()[:_FINGERPRINT_DIGITS]


def _listing(folder: Path) -> str:
    """Return one line per file of a map: checksum and path, sorted by path."""
    paths = [folder / METADATA, folder / RESOURCE_INFO, *(folder / VI_MAP_FOLDER).rglob("*")]
    return "".join(
        f"{_digest(path)}  {path.relative_to(folder).as_posix()}\n"
        for path in sorted(paths)
        if path.is_file()
    )


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
