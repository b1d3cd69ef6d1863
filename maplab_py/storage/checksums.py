"""A side file with the checksum of every file of a map; C++ maplab ignores it."""

import hashlib
import os
import re
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

from maplab_py.errors import MapError
from maplab_py.input_files import read_text
from maplab_py.storage.protobuf.map_files import METADATA, RESOURCE_INFO, VI_MAP_FOLDER

FILE_NAME = "checksums.sha256"
_FINGERPRINT_DIGITS = 16
_DIGEST = re.compile(r"[0-9a-f]{64}")
_MAX_BYTES = 16_000_000
"""Largest size of the side file: enough for a hundred thousand files."""


def write(folder: Path, known: Mapping[str, str] | None = None) -> str:
    """Write the checksums of a map's files, without resources, and return them (`listing`).

    Args:
        known: Checksums of files (paths in the folder) that need not be read.
    """
    listed = listing(folder, known)
    (folder / FILE_NAME).write_text(listed, encoding="utf-8")
    return listed


def fingerprint(folder: Path) -> str:
    """Return a hexadecimal hash of a map's files, without resources.

    Raises:
        OSError: A file cannot be read.
    """
    return fingerprint_of(listing(folder))


def verify(folder: Path, listed: str = "") -> None:
    """Compare all files with the side file, if there is one.

    Args:
        listed: Checksums of the files (`listing`) if they are known already.

    Raises:
        MapError: A file is missing or has changed; the message names it.
    """
    side_file = folder / FILE_NAME
    if not side_file.is_file():
        return
    known = digests_of(listed)
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
        if (known.get(name) or _digest(path)) != digest:
            raise MapError(
                f"{path}: is damaged: it does not have its checksum "
                f"(delete {FILE_NAME} to load it without the check)"
            )


def digests_of(listed: str) -> dict[str, str]:
    """Return the checksums by path in the folder, as they are listed."""
    return {name: digest for digest, _, name in (x.partition("  ") for x in listed.splitlines())}


def fingerprint_of(listed: str) -> str:
    """Return the fingerprint of a map's files whose checksums are listed."""
    return hashlib.sha256(listed.encode()).hexdigest()[:_FINGERPRINT_DIGITS]


def listing(folder: Path, known: Mapping[str, str] | None = None) -> str:
    """Return one line per file of a map, without resources: checksum and path, sorted by path.

    Args:
        known: See `write`.

    Raises:
        OSError: A file cannot be read.
    """
    candidates = [folder / METADATA, folder / RESOURCE_INFO, *(folder / VI_MAP_FOLDER).rglob("*")]
    paths = [path for path in sorted(candidates) if path.is_file()]
    digests = {path.relative_to(folder).as_posix(): "" for path in paths} | dict(known or {})
    unread = [name for name, digest in digests.items() if not digest]
    read = map_in_threads(_digest, [folder / name for name in unread])
    digests.update(zip(unread, read, strict=True))
    return "".join(f"{digest}  {name}\n" for name, digest in digests.items())


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


Result = TypeVar("Result")


def map_in_threads(function: Callable[..., Result], *values: Iterable[Any]) -> list[Result]:
    """Return what a function returns for each value, in their order.

    Where memory does not suffice for the stack of a thread, this thread calls the function.

    Args:
        function: Releases Python's lock; raises no RuntimeError.
        values: One iterable for each argument, all of the same length.
    """
    arguments = list(zip(*values, strict=True))
    try:
        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            return list(pool.map(lambda each: function(*each), arguments))
    except RuntimeError:
        return [function(*each) for each in arguments]
