"""Triangle meshes as PLY, OBJ, STL and GLB files, the last three written and read by trimesh."""

import io
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.array_types import F32, F64, I32, U8
from maplab_py.errors import MapError, UserError
from maplab_py.input_files import DEFAULT_MAX_BYTES, read_bytes
from maplab_py.interop.ply import PlyCloud, encode_ply, parse_ply
from maplab_py.output_files import write_bytes

_SUFFIXES = (".ply", ".obj", ".stl", ".glb")


def check_mesh_path(path: Path) -> None:
    """Check that a file has the suffix of a mesh.

    Raises:
        UserError: It has another one.
    """
    if path.suffix.lower() not in _SUFFIXES:
        raise UserError(f"{path}: a mesh is written as {', '.join(_SUFFIXES)}: choose one of them")


def write_mesh(
    p: F64, faces: I32, path: Path, colours: U8 | None = None, *, overwrite: bool = False
) -> None:
    """Write a mesh in the format that the file's suffix names.

    Args:
        p: Vertices (N, 3) [m].
        faces: Triangles (F, 3), anticlockwise as seen from outside.
        path: File with the suffix .ply, .obj, .stl or .glb.
        colours: Red, green and blue (N, 3) of the vertices; STL has none.

    Raises:
        UserError: The suffix is another one, or the file cannot be written.
    """
    check_mesh_path(path)
    write_bytes(path, _encoded(path.suffix.lower(), p, faces, colours), overwrite=overwrite)


def read_mesh(path: Path) -> PlyCloud:
    """Return the mesh of a file; the axes of glTF are y up and are turned back.

    Raises:
        OSError: The file cannot be read.
        MapError: It is damaged, too large, or has no triangles.
    """
    kind = path.suffix.lower()
    data = read_bytes(path, DEFAULT_MAX_BYTES, remedy="reduce the mesh", error=MapError)
    mesh = _parsed(data, kind, path) if kind in _SUFFIXES[1:] else parse_ply(data, str(path))
    if mesh.faces is None or not len(mesh.faces):
        raise MapError(f"{path} has no triangles: give a mesh")
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.p):
        raise MapError(f"{path}: a triangle refers to a vertex that is not there")
    return mesh


def _parsed(data: bytes, kind: str, path: Path) -> PlyCloud:
    import trimesh

    try:
        content: Any = trimesh.load(
            io.BytesIO(data), file_type=kind[1:], force="mesh", process=False, maintain_order=True
        )
        p = np.asarray(content.vertices, dtype=np.float64).reshape(-1, 3)
        faces = np.asarray(content.faces, dtype=np.int32).reshape(-1, 3)
        colours = content.visual.vertex_colors[:, :3] if content.visual.kind == "vertex" else None
    except Exception as error:
        remedy = f"write it again, as one of {', '.join(_SUFFIXES)}"
        raise MapError(
            f"{path}: is damaged, or no mesh in the format of its name: {remedy}"
        ) from error
    if not np.all(np.isfinite(p)):
        raise MapError(f"{path}: a vertex is not a number: write the mesh again")
    if kind == ".glb":
        p = np.stack([p[:, 0], -p[:, 2], p[:, 1]], axis=1)
    return PlyCloud(p, None if colours is None else np.array(colours, dtype=np.uint8), faces=faces)


def _encoded(kind: str, p: F64, faces: I32, colours: U8 | None) -> list[bytes]:
    import trimesh

    if kind == ".ply":
        return encode_ply(PlyCloud(p, colours, faces=faces))
    if kind == ".glb":  # axes are y up, so that the mesh is turned about x
        p = np.stack([p[:, 0], p[:, 2], -p[:, 1]], axis=1)
    mesh = trimesh.Trimesh(p, faces, vertex_colors=colours, process=False, validate=False)
    content = mesh.export(file_type=kind[1:])
    return [content.encode() if isinstance(content, str) else bytes(content)]


def shown_glb(p: F32, faces: I32, linear: F64, opacity: float) -> bytes:
    """Return a GLB file for a page that shows it as it is: z up, matt and visible from both sides.

    Args:
        p: Vertices (N, 3).
        faces: Triangles (F, 3).
        linear: Colours (N, 3) of the vertices, linear light from 0 to 1.
        opacity: From 0 to 1.
    """
    import trimesh as library

    trimesh: Any = library
    material = trimesh.visual.material.PBRMaterial(
        metallicFactor=0.0, roughnessFactor=1.0, baseColorFactor=[1.0, 1.0, 1.0, opacity],
        doubleSided=True, alphaMode="BLEND" if opacity < 1.0 else "OPAQUE",
    )  # fmt: skip
    mesh = trimesh.Trimesh(
        p, faces, visual=trimesh.visual.TextureVisuals(material=material),
        vertex_attributes={"_COLOR_0": linear}, process=False, validate=False,
    )  # fmt: skip

    def name_colours(tree: Any) -> None:  # those of trimesh have 8 bits, which dark ones share
        attributes = tree["meshes"][0]["primitives"][0]["attributes"]
        attributes["COLOR_0"] = attributes.pop("_COLOR_0")

    return bytes(trimesh.exchange.gltf.export_glb(mesh, tree_postprocessor=name_colours))
