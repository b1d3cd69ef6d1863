"""The surfaces of a world as a triangle mesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from maplab_py.atomic import write_file
from maplab_py.simulation.surfaces import Surfaces


def write_mesh(surfaces: Surfaces, path: Path) -> None:
    """Write surfaces as a binary PLY file: two triangles each, normals into the free space."""
    c, u, v = surfaces.corner, surfaces.side_u, surfaces.side_v
    corners = np.stack([c, c + u, c + u + v, c + v], axis=1)
    # the corners run anticlockwise about u x v; turn those whose normal is the other one
    flipped = np.einsum("fi,fi->f", np.cross(u, v), surfaces.normal) < 0.0
    corners[flipped] = corners[flipped, ::-1]
    first = 4 * np.arange(len(c))[:, None]
    triangles = np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])])
    faces = np.zeros(len(triangles), dtype=[("count", "u1"), ("corner", "<i4", 3)])
    faces["count"], faces["corner"] = 3, triangles
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {4 * len(c)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(triangles)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    write_file(path, [header.encode(), corners.astype("<f4").tobytes(), faces.tobytes()])
