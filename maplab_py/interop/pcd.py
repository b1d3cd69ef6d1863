"""PCD files of the Point Cloud Library: points with colours and intensities.

Source: The PCD file format, documentation of PCL, version 0.7.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maplab_py.array_types import U8
from maplab_py.errors import MapError
from maplab_py.interop.ply import PlyCloud

_TYPES = {"F": "f", "I": "i", "U": "u"}
_MAX_HEADER_BYTES = 100_000
_MAX_POINTS = 100_000_000
_SINGLE = ("x", "y", "z", "intensity", "rgb", "rgba")
"""Fields of one value."""


def parse_pcd(data: bytes, source: str) -> PlyCloud:
    """Read the content of a PCD file (ascii or binary); points with NaN are left out.

    Raises:
        MapError: It is not PCD with x, y, z, it ends early, or it is compressed; names the source.
    """
    header, begin = _header(data, source)
    dtype = _point_type(header, source)
    try:
        count = int(header["POINTS"][0])
    except (KeyError, ValueError, IndexError):
        raise MapError(f"{source}: the PCD header has no number of POINTS") from None
    if not 0 <= count <= _MAX_POINTS:
        raise MapError(f"{source}: the PCD header names {count} points; take fewer")
    form = next(iter(header.get("DATA", [])), "")
    if form == "binary_compressed":
        raise MapError(f"{source}: compressed PCD is not read: save it as binary or ascii")
    if form not in ("ascii", "binary"):
        raise MapError(f"{source}: the PCD header has no line DATA ascii or DATA binary")
    if any(dtype[name].shape for name in dtype.names or () if name in _SINGLE):
        raise MapError(
            f"{source}: the PCD header gives a coordinate, intensity or colour several values (COUNT)"
        )
    try:
        if form == "binary":
            table = np.frombuffer(data, dtype=dtype, count=count, offset=begin)
        else:
            with np.errstate(invalid="raise", over="raise"):  # numbers that do not fit their type
                table = _from_text(data[begin:], dtype, count)
    except (ValueError, FloatingPointError) as error:
        raise MapError(f"{source}: the PCD data end early or do not fit ({error})") from None
    intensity = None
    with np.errstate(invalid="ignore"):  # signalling NaN
        p = np.stack([table[name].astype(np.float64) for name in ("x", "y", "z")], axis=1)
        valid = np.isfinite(p).all(axis=1)
        if "intensity" in (dtype.names or ()):
            intensity = table["intensity"].astype(np.float64)[valid]
    colours = _colours(table)
    return PlyCloud(p[valid], None if colours is None else colours[valid], intensity)


def _header(data: bytes, source: str) -> tuple[dict[str, list[str]], int]:
    """Return the words behind each key, and where the data begin."""
    place = data.find(b"DATA", 0, _MAX_HEADER_BYTES)
    begin = data.find(b"\n", place) + 1
    if place < 0 or begin == 0 or b"FIELDS" not in data[:place]:
        raise MapError(f"{source}: this is not a PCD file")
    lines = data[:begin].decode("ascii", errors="replace").splitlines()
    words = [line.split() for line in lines if line.strip() and not line.startswith("#")]
    return {line[0]: line[1:] for line in words}, begin


def _point_type(header: dict[str, list[str]], source: str) -> np.dtype[np.void]:
    names = header.get("FIELDS", [])
    counts = header.get("COUNT", ["1"] * len(names))
    try:
        fields = []
        for number, (name, size, kind, count) in enumerate(
            zip(names, header["SIZE"], header["TYPE"], counts, strict=True)
        ):
            unique = name if name != "_" and name not in names[:number] else f"_{number}"
            fields.append((unique, f"<{_TYPES[kind]}{int(size)}", (int(count),)))
        plain = [
            (name, kind) if shape == (1,) else (name, kind, shape) for name, kind, shape in fields
        ]
        dtype: np.dtype[np.void] = np.dtype(plain)
    except (KeyError, ValueError, TypeError):
        raise MapError(f"{source}: FIELDS, SIZE, TYPE and COUNT of the PCD header differ") from None
    if not {"x", "y", "z"} <= set(dtype.names or ()):
        raise MapError(f"{source}: the PCD file has no points with x, y, z")
    return dtype


def _from_text(body: bytes, dtype: np.dtype[np.void], count: int) -> NDArray[np.void]:
    widths = [int(np.prod(dtype[name].shape)) for name in dtype.names or ()]
    words = body.split()
    if len(words) < count * sum(widths):
        raise ValueError(f"{len(words)} of {count * sum(widths)} numbers")
    values = np.array(words[: count * sum(widths)], dtype=np.float64)
    columns = values.reshape(count, sum(widths))
    table = np.zeros(count, dtype=dtype)
    first = 0
    for name, width in zip(dtype.names or (), widths, strict=True):
        column = columns[:, first : first + width]
        table[name] = column[:, 0] if dtype[name].shape == () else column.reshape(count, -1)
        first += width
    return table


def _colours(table: NDArray[np.void]) -> U8 | None:
    """Return the colours (N, 3) that PCL packs into the bytes of a number, None without any."""
    names = table.dtype.names or ()
    name = next((name for name in ("rgb", "rgba") if name in names), None)
    if name is None or table.dtype[name].itemsize != 4:
        return None
    packed = np.ascontiguousarray(table[name]).view(np.uint32)
    channels = [(packed >> shift) & 0xFF for shift in (16, 8, 0)]
    return np.stack(channels, axis=1).astype(np.uint8)
