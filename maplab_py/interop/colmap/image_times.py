"""Times of a model's images: from their names, from a file, or from their order."""

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath

import numpy as np

from maplab_py.array_types import I64
from maplab_py.errors import MapError, UserError
from maplab_py.input_files import read_text

_NS_PER_S = 1_000_000_000
_MAX_FILE_BYTES = 1_000_000_000
_NUMBER = re.compile(r"\d+(?:\.\d+)?")
_UNITS = ((17, 1), (14, 1_000), (11, 1_000_000))
"""Least digits of whole numbers that are ns, us, ms; fewer are no time stamps."""


def image_times(
    names: tuple[str, ...], source: str, file: Path | None, *, interval_s: float
) -> I64:
    """Return the times (N,) [ns] of images.

    Args:
        names: Names of the images.
        source: name = the last number in the file's name: ns with 17 digits or more, us with 14, ms with
            11, or seconds with a decimal point; file = lines of name and time stamp [ns]; order =
            images in the order of their names without folders, which equal frames share.
        file: The file.
        interval_s: Time between images by order [s].

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
        times = read_times(file)
        missing = [name for name in names if name not in times]
        if missing:
            raise UserError(f"{file}: has no time stamp of image {missing[0]}: add a line for it")
        return np.array([times[name] for name in names], dtype=np.int64)
    return np.array([_time_of_name(name) for name in names], dtype=np.int64)


def read_times(file: Path) -> dict[str, int]:
    """Return the times [ns] of images by name: lines `name stamp` or `name,stamp`.

    Raises:
        MapError: The file cannot be read, or a line is wrong; names the line.
    """
    try:
        text = read_text(file, _MAX_FILE_BYTES, remedy="split it", error=MapError)
    except UnicodeDecodeError:
        raise MapError(f"{file}: is not text: name a file of image names and time stamps") from None
    except OSError as error:
        raise MapError(f"cannot read {file}: {error.strerror}") from error
    times: dict[str, int] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        content = line.strip()
        if not content or content.startswith("#"):
            continue
        match = re.fullmatch(r"(.+?)[\s,]+(\d{1,19})", content)
        if match is None or int(match[2]) >= 1 << 63:
            raise MapError(f"{file}:{number}: wants an image name and a time stamp in whole ns")
        if match[1] in times:
            raise MapError(f"{file}:{number}: image {match[1]} is there twice")
        times[match[1]] = int(match[2])
    return times


def _time_of_name(name: str) -> int:
    numbers = _NUMBER.findall(PurePosixPath(name).stem)
    text = numbers[-1] if numbers else ""
    whole, _, fraction = text.partition(".")
    if fraction:
        return int(whole) * _NS_PER_S + int(fraction[:9].ljust(9, "0"))
    for digits, unit_ns in _UNITS:
        if len(whole) >= digits and int(whole) * unit_ns < 1 << 63:
            return int(whole) * unit_ns
    raise UserError(
        f"image {name}: its name has no time stamp (ns, us, ms, or seconds with a decimal point): give "
        "--timestamps_from=order, or =file with --timestamps_file"
    )
