"""Times of a model's images: from their names, from a file, or from their order."""

from __future__ import annotations

import re
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path, PurePosixPath

import numpy as np

from maplab_py.array_types import I64
from maplab_py.errors import MapError, UserError
from maplab_py.input_files import read_text
from maplab_py.interop.stamps import IMAGES, parse_stamps

_NS_PER_S = 1_000_000_000
_MAX_FILE_BYTES = 1_000_000_000
_NUMBER = re.compile(r"\d+(?:\.\d+)?")
_FEWEST_DIGITS = 9
"""Shorter whole numbers in names count images."""


def image_times(
    names: tuple[str, ...],
    source: str,
    file: Path | None,
    *,
    interval_s: float,
    time_unit: str = "",
) -> I64:
    """Return the times (N,) [ns] of images.

    Args:
        names: Names of the images.
        source: name = the last number in the file's name; file = lines of name and time stamp; order =
            images in the order of their names without folders, which equal frames share.
        file: The file.
        interval_s: Time between images by order [s].
        time_unit: Unit of the stamps; empty = see `stamps`.

    Raises:
        UserError: A name has no time stamp, or the file is not given or lacks an image.
        MapError: The file is damaged.
    """
    if source == "order":
        stems = np.array([PurePosixPath(name).name for name in names])
        _, row = np.unique(stems, return_inverse=True)
        return np.asarray((row + 1) * round(interval_s * _NS_PER_S), dtype=np.int64)
    if source == "file":
        if file is None:
            raise UserError("--timestamps_from=file needs the file: give --timestamps_file=FILE")
        times = read_times(file, time_unit)
        missing = [name for name in names if name not in times]
        if missing:
            raise UserError(f"{file}: has no time stamp of image {missing[0]}: add a line for it")
        return np.array([times[name] for name in names], dtype=np.int64)
    tokens = [_stamp_of_name(name) for name in names]
    return _times_ns(names, tokens, "names of images", None, time_unit)


def read_times(file: Path, time_unit: str = "") -> dict[str, int]:
    """Return the times [ns] of images by name: lines `name stamp` or `name,stamp`.

    Raises:
        MapError: The file cannot be read, a line is wrong, or the unit is open; names the line.
    """
    try:
        text = read_text(file, _MAX_FILE_BYTES, remedy="split it", error=MapError)
    except UnicodeDecodeError:
        raise MapError(f"{file}: is not text: name a file of image names and time stamps") from None
    except OSError as error:
        raise MapError(f"cannot read {file}: {error.strerror}") from error
    stamps: dict[str, tuple[int, str]] = {}
    header = ""
    for number, line in enumerate(text.splitlines(), start=1):
        content = line.strip()
        if not content or content.startswith("#"):
            header = header or content
            continue
        match = re.fullmatch(r"(.+?)[\s,]+([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?)", content)
        if match is None:
            raise MapError(f"{file}:{number}: wants an image name and a time stamp")
        if match[1] in stamps:
            raise MapError(f"{file}:{number}: image {match[1]} is there twice")
        stamps[match[1]] = (number, match[2])
    if not stamps:
        raise MapError(f"{file}: there are no rows in the file: write or copy it again")
    lines, tokens = zip(*stamps.values(), strict=True)
    times_ns = _times_ns(tuple(stamps), tokens, str(file), lines, time_unit, header)
    return dict(zip(stamps, times_ns.tolist(), strict=True))


def _times_ns(
    names: tuple[str, ...],
    tokens: Sequence[str],
    source: str,
    lines: Sequence[int] | None,
    time_unit: str,
    header: str = "",
) -> I64:
    """Return times whose unit follows from the folder with the most images, in the order of time."""
    if not tokens:
        return np.zeros(0, dtype=np.int64)
    if not time_unit:
        folders = [str(PurePosixPath(name).parent) for name in names]
        largest = max(sorted(set(folders)), key=folders.count)
        rows = [row for row, folder in enumerate(folders) if folder == largest]
        rows.sort(key=lambda row: Decimal(tokens[row]))
        part = [tokens[row] for row in rows]
        places = [row + 1 if lines is None else lines[row] for row in rows]
        time_unit = parse_stamps(part, IMAGES, source, places, header=header).unit
    return parse_stamps(tokens, IMAGES, source, lines, unit=time_unit).times_ns


def _stamp_of_name(name: str) -> str:
    numbers = _NUMBER.findall(PurePosixPath(name).stem)
    text = numbers[-1] if numbers else ""
    if "." in text or _FEWEST_DIGITS <= len(text) < 20:
        return text
    raise UserError(
        f"image {name}: its name has no time stamp: give --timestamps_from=order, or =file with "
        "--timestamps_file"
    )
