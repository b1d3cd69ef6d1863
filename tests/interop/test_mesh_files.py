"""Meshes as files of every format hold the same triangles."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import MapError, UserError
from maplab_py.interop.mesh_files import read_mesh, write_mesh
from maplab_py.interop.ply import parse_ply

P = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 3.0]])
FACES = np.array([[0, 2, 1], [0, 1, 3]], dtype=np.int32)


def test_ply(tmp_path: Path) -> None:
    write_mesh(P, FACES, tmp_path / "mesh.ply")
    cloud = parse_ply((tmp_path / "mesh.ply").read_bytes(), "mesh.ply")
    np.testing.assert_array_equal(cloud.p, P)
    np.testing.assert_array_equal(cloud.faces, FACES)


def test_obj(tmp_path: Path) -> None:
    write_mesh(P, FACES, tmp_path / "mesh.obj")
    text = (tmp_path / "mesh.obj").read_text()
    words = [line.split() for line in text.splitlines() if line]
    vertices = [list(map(float, line[1:])) for line in words if line[0] == "v"]
    np.testing.assert_array_equal(vertices, P)
    faces = [list(map(int, line[1:])) for line in words if line[0] == "f"]
    np.testing.assert_array_equal(faces, FACES + 1)


def test_stl(tmp_path: Path) -> None:
    write_mesh(P, FACES, tmp_path / "mesh.stl")
    data = (tmp_path / "mesh.stl").read_bytes()
    assert len(data) == 84 + 50 * len(FACES)
    assert int.from_bytes(data[80:84], "little") == len(FACES)
    numbers = np.frombuffer(data[84:134], dtype="<f4", count=12).reshape(4, 3)
    np.testing.assert_array_equal(numbers[0], [0.0, 0.0, -1.0])
    np.testing.assert_array_equal(numbers[1:], P[FACES[0]])


def test_glb(tmp_path: Path) -> None:
    write_mesh(P, FACES, tmp_path / "mesh.glb")
    data = (tmp_path / "mesh.glb").read_bytes()
    header = np.frombuffer(data[:20], dtype="<u4")
    assert data[:4] == b"glTF"
    assert header[2] == len(data)
    scene = json.loads(data[20 : 20 + header[3]])
    body = data[20 + int(header[3]) + 8 :]
    primitive = scene["meshes"][0]["primitives"][0]
    place, rows = (
        scene["accessors"][k] for k in (primitive["attributes"]["POSITION"], primitive["indices"])
    )
    views = [scene["bufferViews"][accessor["bufferView"]] for accessor in (place, rows)]
    start = views[0]["byteOffset"]
    positions = np.frombuffer(body, dtype="<f4", count=12, offset=start).reshape(4, 3)
    np.testing.assert_array_equal(positions, np.stack([P[:, 0], P[:, 2], -P[:, 1]], axis=1))
    start = views[1]["byteOffset"]
    indices = np.frombuffer(body, dtype="<u4", count=6, offset=start).reshape(-1, 3)
    np.testing.assert_array_equal(indices, FACES)
    assert place["max"] == [1.0, 3.0, 0.0]
    assert len(data) % 4 == 0


def test_colours(tmp_path: Path) -> None:
    colours = np.arange(12, dtype=np.uint8).reshape(4, 3) * 20
    for suffix in ("ply", "obj", "stl", "glb"):
        write_mesh(P, FACES, tmp_path / f"mesh.{suffix}", colours)
    cloud = parse_ply((tmp_path / "mesh.ply").read_bytes(), "mesh.ply")
    np.testing.assert_array_equal(cloud.colours, colours)
    lines = (tmp_path / "mesh.obj").read_text().splitlines()
    read = [list(map(float, line.split()[4:])) for line in lines if line.startswith("v ")]
    np.testing.assert_allclose(read, colours / 255.0, atol=1e-4)
    data = (tmp_path / "mesh.glb").read_bytes()
    scene = json.loads(data[20 : 20 + int(np.frombuffer(data, "<u4", 1, 12)[0])])
    place = scene["accessors"][scene["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
    view = scene["bufferViews"][place["bufferView"]]
    body = data[len(data) - scene["buffers"][0]["byteLength"] :]
    painted = np.frombuffer(body, np.uint8, 16, view["byteOffset"]).reshape(4, 4)
    np.testing.assert_array_equal(painted[:, :3], colours)
    assert (painted[:, 3] == 255).all()


def test_other_formats_and_existing_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"\.ply, \.obj, \.stl, \.glb"):
        write_mesh(P, FACES, tmp_path / "mesh.fbx")
    write_mesh(P, FACES, tmp_path / "mesh.stl")
    with pytest.raises(UserError, match="--overwrite"):
        write_mesh(P, FACES, tmp_path / "mesh.stl")


@pytest.mark.parametrize("kind", ["ply", "obj", "stl", "glb"])
def test_every_format_reads_back(kind: str, tmp_path: Path) -> None:
    colours = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [10, 20, 30]], dtype=np.uint8)
    path = tmp_path / f"mesh.{kind}"
    write_mesh(P, FACES, path, colours)
    read = read_mesh(path)
    assert read.faces is not None
    np.testing.assert_allclose(read.p[read.faces], P[FACES], atol=1e-7)
    if kind == "stl":
        assert read.colours is None
    else:
        assert read.colours is not None
        np.testing.assert_array_equal(read.colours[read.faces], colours[FACES])


@pytest.mark.parametrize("kind", ["ply", "obj", "stl", "glb"])
def test_damaged_meshes_are_refused_by_name(kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"mesh.{kind}"
    write_mesh(P, FACES, path)
    data = path.read_bytes()
    for cut in (b"", b"\xff\xfe", data[: len(data) // 4]):
        path.write_bytes(cut)
        with pytest.raises(MapError, match=rf"mesh\.{kind}"):
            read_mesh(path)
