"""PLY files: points with colours and intensities, and triangle meshes.

Source: Greg Turk, The PLY Polygon File Format, 1994.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.array_types import F64, U8, NDArray
from maplab_py.errors import MapError
from maplab_py.input_files import DEFAULT_MAX_BYTES
from maplab_py.output_files import write_bytes

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
    "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
_MAX_HEADER_BYTES = 100_000
_BYTES_PER_POINT = 110
"""Memory of a point [bytes] while columns are read and concatenated."""
_TEXT_PARTS = 60
"""Memory of the words of an ascii file per byte of the file."""
INTENSITIES = (
    "intensity",
    "scalar_intensity",
    "scalar_Intensity",
    "i",
    "intensities",
    "reflectivity",
)


@dataclasses.dataclass(frozen=True, eq=False)
class PlyCloud:
    """Content of a PLY file."""

    p: F64  # (N, 3) [m]
    colours: U8 | None = None  # (N, 3)
    intensity: F64 | None = None  # (N,)
    faces: NDArray[np.int32] | None = None  # (F, 3)

    def where(self, rows: Any) -> PlyCloud:
        """Return the points where a mask (N,) is set, without faces."""
        colours = None if self.colours is None else self.colours[rows]
        intensity = None if self.intensity is None else self.intensity[rows]
        return PlyCloud(self.p[rows], colours, intensity)


class EmptyCloud(MapError):
    """A cloud without a point that is finite."""


@dataclasses.dataclass
class _Element:
    name: str
    count: int
    fields: list[tuple[str, str]]  # name and numpy type
    list_types: tuple[str, str] | None = None  # types of the count and of the entries


def parse_ply(data: bytes, source: str, max_bytes: int = DEFAULT_MAX_BYTES) -> PlyCloud:
    """Read the content of a PLY file.

    Raises:
        MapError: It is not PLY with vertices x, y, z, or takes more memory than twice max_bytes;
            names the source.
    """
    order, elements, begin = _header(data, source)
    wanted = _BYTES_PER_POINT * sum(e.count for e in elements if e.name in ("vertex", "face"))
    if order == "=":
        wanted += _TEXT_PARTS * len(data)
    if wanted > 2 * max_bytes:
        raise MapError(
            f"{source}: the PLY data take more than {2 * max_bytes / 1e6:g} MB of memory; "
            "take fewer points" + (", or the binary format" if order == "=" else "")
        )
    vertices: NDArray[np.void] | None = None
    faces: NDArray[np.int32] | None = None
    body = memoryview(data)[begin:]
    try:
        if order == "=":
            with np.errstate(invalid="raise", over="raise"):  # numbers that do not fit their type
                vertices, faces = _read_ascii(body, elements)
        else:
            vertices, faces = _read_binary(body, elements, order)
    except (ValueError, IndexError, ArithmeticError) as error:
        raise MapError(f"{source}: the PLY data end early or do not fit ({error})") from None
    if vertices is None or not {"x", "y", "z"} <= set(vertices.dtype.names or ()):
        raise MapError(f"{source}: the PLY file has no vertices with x, y, z")
    return dataclasses.replace(cloud_of_table(vertices), faces=faces)


def cloud_of_table(table: NDArray[np.void]) -> PlyCloud:
    """Return the points of a table with the columns x, y, z, and its intensities and colours."""
    names = table.dtype.names or ()
    with np.errstate(invalid="ignore"):  # signalling NaN
        p = np.stack([table[n].astype(np.float64) for n in ("x", "y", "z")], axis=1)
        intensity = next((table[n].astype(np.float64) for n in INTENSITIES if n in names), None)
        return PlyCloud(p, _colours(table), intensity)


def _header(data: bytes, source: str) -> tuple[str, list[_Element], int]:
    end = data.find(b"end_header", 0, _MAX_HEADER_BYTES)
    if not data.startswith(b"ply") or end < 0:
        raise MapError(f"{source}: this is not a PLY file")
    begin = data.find(b"\n", end) + 1 or len(data)
    order, elements = "", list[_Element]()
    for line in data[:end].decode("ascii", errors="replace").splitlines():
        words = line.split()
        try:
            if words[:1] == ["format"]:
                order = _ORDERS[words[1]]
            elif words[:1] == ["element"]:
                elements.append(_Element(words[1], _count(words[2]), []))
            elif words[:2] == ["property", "list"]:
                elements[-1].list_types = (_TYPES[words[2]], _TYPES[words[3]])
            elif words[:1] == ["property"]:
                elements[-1].fields.append((words[2], _TYPES[words[1]]))
        except (KeyError, IndexError, ValueError):
            raise MapError(f"{source}: the PLY header has a wrong line '{line.strip()}'") from None
    if not order:
        raise MapError(f"{source}: the PLY header states no format")
    return order, elements, begin


def _count(word: str) -> int:
    if not word.isdecimal():
        raise ValueError(word)
    return int(word)


def _read_binary(
    body: memoryview, elements: list[_Element], order: str
) -> tuple[NDArray[np.void] | None, NDArray[np.int32] | None]:
    vertices, faces, place = None, None, 0
    for element in elements:
        if element.list_types is not None and (element.fields or element.name != "face"):
            break  # not needed, and its length is not known in advance
        dtype = np.dtype([(name, order + kind) for name, kind in element.fields])
        if element.list_types is not None:
            count, entry = (order + kind for kind in element.list_types)
            dtype = np.dtype([("n", count), ("v", entry, (3,))])
        block = np.frombuffer(body, dtype=dtype, count=element.count, offset=place)
        place += block.nbytes
        if element.name == "vertex":
            vertices = block
        elif element.name == "face":
            if not (block["n"] == 3).all():
                raise ValueError("a face is not a triangle")
            faces = block["v"].astype(np.int32)
    return vertices, faces


def _read_ascii(
    body: memoryview, elements: list[_Element]
) -> tuple[NDArray[np.void] | None, NDArray[np.int32] | None]:
    lines = str(body, "ascii", errors="replace").splitlines()
    vertices, faces, place = None, None, 0
    for element in elements:
        rows = lines[place : place + element.count]
        place += element.count
        if len(rows) < element.count:
            raise ValueError(f"{element.name}: {len(rows)} of {element.count} lines")
        if element.name not in ("vertex", "face"):
            continue
        if element.name == "face":
            table = np.array([row.split()[:4] for row in rows], dtype=np.int64).reshape(-1, 4)
            if not (table[:, 0] == 3).all():
                raise ValueError("a face is not a triangle")
            faces = table[:, 1:].astype(np.int32)
            continue
        values = np.array(" ".join(rows).split(), dtype=np.float64)
        values = values.reshape(element.count, len(element.fields))
        vertices = np.zeros(element.count, dtype=np.dtype(element.fields))
        for column, (name, _) in enumerate(element.fields):
            vertices[name] = values[:, column]
    return vertices, faces


def _colours(table: NDArray[np.void]) -> U8 | None:
    names = table.dtype.names or ()
    for triple in (("red", "green", "blue"), ("r", "g", "b")):
        if set(triple) <= set(names):
            columns = np.stack([table[name] for name in triple], axis=1)
            if columns.dtype.kind == "f":
                columns = np.round(255.0 * np.clip(np.nan_to_num(columns), 0.0, 1.0))
            return columns.astype(np.uint8)
    packed = next((table[name] for name in ("rgb", "rgba") if name in names), None)
    if packed is None or packed.dtype.itemsize != 4:  # PCL packs bytes into a number
        return None
    words = np.ascontiguousarray(packed.astype(packed.dtype.newbyteorder("="))).view(np.uint32)
    return np.stack([words >> 16, words >> 8, words], axis=1).astype(np.uint8)


def write_ply(cloud: PlyCloud, path: Path, *, overwrite: bool = True) -> None:
    """Write a cloud or mesh as binary PLY; see `encode_ply`.

    Raises:
        UserError: The file cannot be written, or exists and `overwrite` is not set.
    """
    write_bytes(path, encode_ply(cloud), overwrite=overwrite)


def encode_ply(cloud: PlyCloud) -> list[bytes]:
    """Return points, with the colours, intensities and faces that there are, as binary PLY."""
    fields = [(name, "<f4") for name in ("x", "y", "z")]
    columns: list[NDArray[Any]] = [cloud.p[:, axis] for axis in range(3)]
    if cloud.intensity is not None:
        fields.append(("intensity", "<f4"))
        columns.append(cloud.intensity)
    if cloud.colours is not None:
        fields += [(name, "u1") for name in ("red", "green", "blue")]
        columns += [cloud.colours[:, axis] for axis in range(3)]
    table = np.zeros(len(cloud.p), dtype=np.dtype(fields))
    for (name, _), values in zip(fields, columns, strict=True):
        table[name] = values
    kinds = {"<f4": "float", "u1": "uchar"}
    lines = [f"property {kinds[kind]} {name}" for name, kind in fields]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}", *lines]
    chunks = [table.tobytes()]
    if cloud.faces is not None:
        faces = np.zeros(len(cloud.faces), dtype=[("count", "u1"), ("corner", "<i4", 3)])
        faces["count"], faces["corner"] = 3, cloud.faces
        head += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        chunks.append(faces.tobytes())
    return [("\n".join([*head, "end_header"]) + "\n").encode(), *chunks]
