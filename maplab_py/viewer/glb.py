"""A triangle mesh with a colour at each corner as a binary glTF file (Khronos, glTF 2.0)."""

from __future__ import annotations

import json
import struct

import numpy as np

from maplab_py.array_types import U8
from maplab_py.viewer.colours import linear_light
from maplab_py.viewer.scene import Mesh

_FLOAT, _UINT16, _UINT32 = 5126, 5123, 5125
_VERTICES, _INDICES = 34962, 34963  # targets of buffer views


def coloured_glb(mesh: Mesh) -> bytes:
    """Return the file of a mesh; it is matt and visible from both sides.

    glTF's colours are linear light; 16 bits keep dark ones apart.
    """
    p = np.ascontiguousarray(mesh.p, dtype="<f4")
    colour = np.full((len(p), 4), 65535, dtype="<u2")
    colour[:, :3] = np.round(65535.0 * linear_light(np.broadcast_to(mesh.colours, (len(p), 3))))
    faces = np.ascontiguousarray(mesh.faces, dtype="<u4")
    blocks = [p.tobytes(), colour.tobytes(), faces.tobytes()]  # each a multiple of 4 bytes
    starts = np.cumsum([0, *(len(block) for block in blocks)]).tolist()
    views = [
        {"buffer": 0, "byteOffset": start, "byteLength": len(block), "target": target}
        for start, block, target in zip(
            starts, blocks, (_VERTICES, _VERTICES, _INDICES), strict=False
        )
    ]
    accessors = [
        {
            "bufferView": 0, "componentType": _FLOAT, "count": len(p), "type": "VEC3",
            "min": p.min(axis=0).tolist(), "max": p.max(axis=0).tolist(),
        },
        {
            "bufferView": 1, "componentType": _UINT16, "count": len(p), "type": "VEC4",
            "normalized": True,
        },
        {"bufferView": 2, "componentType": _UINT32, "count": faces.size, "type": "SCALAR"},
    ]  # fmt: skip
    primitive = {"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0}
    matt = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    content = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}], "meshes": [{"primitives": [primitive]}],
        "materials": [{"pbrMetallicRoughness": matt, "doubleSided": True}],
        "buffers": [{"byteLength": starts[-1]}], "bufferViews": views, "accessors": accessors,
    }  # fmt: skip
    return _container(json.dumps(content).encode(), b"".join(blocks))


def _container(text: bytes, data: bytes) -> bytes:
    """Return the file of a JSON and a binary chunk."""
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + len(data)
    header = struct.pack("<4sII", b"glTF", 2, total)
    chunks = [struct.pack("<I4s", len(text), b"JSON"), text]
    chunks += [struct.pack("<I4s", len(data), b"BIN\0"), data]
    return header + b"".join(chunks)


def is_coloured(mesh: Mesh) -> bool:
    """Tell whether the corners of a mesh have a colour each."""
    colour: U8 = mesh.colours
    return colour.ndim == 2
