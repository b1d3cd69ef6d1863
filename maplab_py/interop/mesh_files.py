"""Triangle meshes as PLY, OBJ, STL and GLB files.

Sources: Wavefront OBJ; StereoLithography interface, binary; Khronos glTF 2.0, binary container.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.array_types import F64, I32, U8
from maplab_py.errors import UserError
from maplab_py.interop.ply import PlyCloud, encode_ply
from maplab_py.output_files import write_bytes

_GLB_MAGIC, _GLB_JSON, _GLB_BINARY = 0x46546C67, 0x4E4F534A, 0x004E4942
_FLOAT, _UNSIGNED_INT, _UNSIGNED_BYTE = 5126, 5125, 5121
_ARRAY_BUFFER, _ELEMENT_BUFFER = 34962, 34963
_LINES_PER_CHUNK = 10_000


def check_mesh_path(path: Path) -> None:
    """Check that a file has the suffix of a mesh.

    Raises:
        UserError: It has another one.
    """
    if path.suffix.lower() not in _ENCODERS:
        raise UserError(f"{path}: a mesh is written as {', '.join(_ENCODERS)}: choose one of them")


def write_mesh(
    p: F64, faces: I32, path: Path, colours: U8 | None = None, *, overwrite: bool = False
) -> None:
    """Write a mesh in the format that the file's suffix names.

    Args:
        p: Vertices (N, 3) [m].
        faces: Triangles (F, 3), anticlockwise as seen from outside.
        path: File with the suffix .ply, .obj, .stl or .glb.
        colours: Red, green and blue (N, 3) of the vertices; STL has none.
        overwrite: Replace a file that exists.

    Raises:
        UserError: The suffix is another one, or the file cannot be written.
    """
    check_mesh_path(path)
    write_bytes(path, _ENCODERS[path.suffix.lower()](p, faces, colours), overwrite=overwrite)


def _ply(p: F64, faces: I32, colours: U8 | None) -> list[bytes]:
    return encode_ply(PlyCloud(p, colours, faces=faces))


def _obj(p: F64, faces: I32, colours: U8 | None) -> list[bytes]:
    """Return Wavefront OBJ; colours follow the coordinates, as most programs read them."""
    chunks = [b"# vertices in metres, z up\n"]
    for first in range(0, len(p), _LINES_PER_CHUNK):
        rows = p[first : first + _LINES_PER_CHUNK].tolist()
        tails = [""] * len(rows)
        if colours is not None:
            shares = (colours[first : first + _LINES_PER_CHUNK] / 255.0).tolist()
            tails = [f" {red:.4f} {green:.4f} {blue:.4f}" for red, green, blue in shares]
        chunks.append(
            "".join(
                f"v {x:.6f} {y:.6f} {z:.6f}{tail}\n"
                for (x, y, z), tail in zip(rows, tails, strict=True)
            ).encode()
        )
    for first in range(0, len(faces), _LINES_PER_CHUNK):
        corners = (faces[first : first + _LINES_PER_CHUNK] + 1).tolist()
        chunks.append("".join(f"f {a} {b} {c}\n" for a, b, c in corners).encode())
    return chunks


def _stl(p: F64, faces: I32, colours: U8 | None) -> list[bytes]:  # noqa: ARG001
    corners = p[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    table = np.zeros(
        len(faces), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]
    )
    table["normal"], table["corners"] = normals, corners
    count = np.array([len(faces)], dtype="<u4")
    return [b"binary STL, metres, z up".ljust(80), count.tobytes(), table.tobytes()]


def _glb(p: F64, faces: I32, colours: U8 | None) -> list[bytes]:
    """Return a glTF scene; its axes are y up, so that the mesh is turned about x."""
    turned = np.stack([p[:, 0], p[:, 2], -p[:, 1]], axis=1).astype("<f4")
    indices = faces.astype("<u4")
    views = [
        {"buffer": 0, "byteOffset": 0, "byteLength": turned.nbytes, "target": _ARRAY_BUFFER},
        {
            "buffer": 0,
            "byteOffset": turned.nbytes,
            "byteLength": indices.nbytes,
            "target": _ELEMENT_BUFFER,
        },
    ]
    painted = np.full((len(p) if colours is not None else 0, 4), 255, dtype=np.uint8)
    if colours is not None:
        painted[:, :3] = colours
    bounds = turned if len(turned) else np.zeros((1, 3), dtype="<f4")
    positions = {
        "bufferView": 0,
        "componentType": _FLOAT,
        "count": len(turned),
        "type": "VEC3",
        "min": bounds.min(axis=0).tolist(),
        "max": bounds.max(axis=0).tolist(),
    }
    triangles = {
        "bufferView": 1,
        "componentType": _UNSIGNED_INT,
        "count": indices.size,
        "type": "SCALAR",
    }
    attributes = {"POSITION": 0}
    accessors = [positions, triangles]
    if colours is not None:
        place = turned.nbytes + indices.nbytes
        views.append(
            {
                "buffer": 0,
                "byteOffset": place,
                "byteLength": painted.nbytes,
                "target": _ARRAY_BUFFER,
            }
        )
        attributes["COLOR_0"] = len(accessors)
        accessors.append(
            {
                "bufferView": 2,
                "componentType": _UNSIGNED_BYTE,
                "normalized": True,
                "count": len(painted),
                "type": "VEC4",
            }
        )
    scene: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "maplab-py"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 1}]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": turned.nbytes + indices.nbytes + painted.nbytes}],
    }
    text = json.dumps(scene, sort_keys=True).encode()
    text = text.ljust(-(-len(text) // 4) * 4)
    body = turned.tobytes() + indices.tobytes() + painted.tobytes()
    size = 12 + 8 + len(text) + 8 + len(body)
    return [
        np.array([_GLB_MAGIC, 2, size, len(text), _GLB_JSON], dtype="<u4").tobytes(),
        text,
        np.array([len(body), _GLB_BINARY], dtype="<u4").tobytes(),
        body,
    ]


_ENCODERS = {".ply": _ply, ".obj": _obj, ".stl": _stl, ".glb": _glb}
