"""PLY in all encodings, PCD of every type, meshes in every format."""

import json
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import MapError, UserError
from maplab_py.interop.mesh_files import read_mesh, write_mesh
from maplab_py.interop.ply import PlyCloud, parse_ply, write_ply
from maplab_py.interop.resources.point_clouds import parse_pcd
from tests.support.own_process import in_own_process

HEAD = b"ply\nformat %s 1.0\ncomment by hand\nelement vertex 3\n"
FIELDS = b"property double x\nproperty float y\nproperty float z\nproperty uchar red\n"
FIELDS += b"property uchar green\nproperty uchar blue\nproperty float intensity\n"
FACE = b"element face 1\nproperty list uchar int vertex_indices\nend_header\n"
ROWS = [(1.0, 2.0, 3.0, 10, 20, 30, 0.5), (4.0, 5.0, 6.0, 40, 50, 60, 0.25), (0.0,) * 7]


def _file(encoding: str) -> bytes:
    head = HEAD % encoding.encode() + FIELDS + FACE
    if encoding == "ascii":
        lines = [" ".join(str(v) for v in row) for row in ROWS]
        return head + ("\n".join(lines) + "\n3 0 1 2\n").encode()
    order = "<" if "little" in encoding else ">"
    kinds = ("f8", "f4", "f4", "u1", "u1", "u1", "f4")
    dtype = np.dtype([(f"f{i}", order + kind) for i, kind in enumerate(kinds)])
    face = np.array([(3, (0, 1, 2))], dtype=[("n", "u1"), ("v", order + "i4", 3)])
    return head + np.array(ROWS, dtype=dtype).tobytes() + face.tobytes()


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_all_encodings_say_the_same(encoding: str) -> None:
    cloud = parse_ply(_file(encoding), "test")
    np.testing.assert_array_equal(cloud.p, [row[:3] for row in ROWS])
    assert cloud.colours is not None
    assert cloud.intensity is not None
    assert cloud.faces is not None
    np.testing.assert_array_equal(cloud.colours, [row[3:6] for row in ROWS])
    np.testing.assert_array_equal(cloud.intensity, [row[6] for row in ROWS])
    np.testing.assert_array_equal(cloud.faces, [[0, 1, 2]])


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    colours = rng.integers(0, 255, (50, 3)).astype(np.uint8)
    cloud = PlyCloud(rng.normal(size=(50, 3)), colours, rng.uniform(size=50))
    write_ply(cloud, tmp_path / "cloud.ply")
    back = parse_ply((tmp_path / "cloud.ply").read_bytes(), "cloud.ply")
    np.testing.assert_allclose(back.p, cloud.p, rtol=1e-6)
    np.testing.assert_array_equal(back.colours, colours)
    np.testing.assert_allclose(back.intensity, cloud.intensity, rtol=1e-6)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"no ply", "not a PLY file"),
        (b"ply\nelement vertex 1\nend_header\n", "states no format"),
        (
            b"ply\nformat ascii 1.0\nelement vertex one\nend_header\n",
            "wrong line 'element vertex one'",
        ),
        (
            b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nend_header\n1\n",
            "end early",
        ),
        (
            b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n",
            "no vertices",
        ),
        (_file("binary_little_endian")[:-20], "end early"),
    ],
)
def test_damaged_files_are_refused(data: bytes, reason: str) -> None:
    with pytest.raises(MapError, match=f"cloud.ply: .*{reason}"):
        parse_ply(data, "cloud.ply")


_POSITION = ("float x", "float y", "float z")
_LARGEST = {
    "wide points": ("binary_little_endian", (*_POSITION, *(f"uchar f{i}" for i in range(500)))),
    "colours of doubles": (
        "binary_big_endian",
        (*_POSITION, "double red", "double green", "double blue", "float intensity"),
    ),
    "text": ("ascii", _POSITION),
}


def _peak_of_parsing(data: bytes, bound: int) -> int:
    """Return the peak of memory while a file is parsed [bytes]."""
    tracemalloc.start()
    parse_ply(data, "cloud", bound)
    return tracemalloc.get_traced_memory()[1]


@pytest.mark.parametrize("name", _LARGEST)
def test_reading_takes_at_most_twice_the_bound(name: str) -> None:
    """The largest number of points that is accepted, found by bisection."""
    encoding, properties = _LARGEST[name]
    size = sum(np.dtype({"float": "f4", "uchar": "u1", "double": "f8"}[p.split()[0]]).itemsize
               for p in properties)  # fmt: skip
    bound = 1_000_000
    refusals = set[str]()

    def content(count: int) -> bytes:
        lines = ["ply", f"format {encoding} 1.0", f"element vertex {count}"]
        lines += [f"property {line}" for line in properties] + ["end_header\n"]
        row = b"1 1 1\n" if encoding == "ascii" else bytes(size)
        return "\n".join(lines).encode() + row * count

    def is_accepted(count: int) -> bool:
        try:
            parse_ply(content(count), "cloud", bound)
        except MapError as error:
            refusals.add(str(error))
            return False
        return True

    accepted, refused = 1, 100_000
    while refused - accepted > 100:
        middle = (accepted + refused) // 2
        accepted, refused = (middle, refused) if is_accepted(middle) else (accepted, middle)
    data = content(accepted)
    peak_bytes = in_own_process(_peak_of_parsing, data, bound)
    assert accepted > 1000
    assert all("take more than 2 MB of memory" in line for line in refusals)
    assert peak_bytes < 2 * bound


HEADER = (
    "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z _ rgb ring\nSIZE 4 4 4 1 4 2\nTYPE F F F U U U\n"
    "COUNT 1 1 1 4 1 1\nWIDTH 3\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 3\n"
)
P = np.array([[1.0, 2.0, 3.0], [np.nan, 0.0, 0.0], [-4.0, 5.5, 6.0]])
COLOURS = [0x0A141E, 0, 0xFF0080]


def binary() -> bytes:
    fields = [
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("gap", "u1", 4),
        ("rgb", "<u4"),
        ("ring", "<u2"),
    ]
    table = np.zeros(3, dtype=fields)
    for column, name in enumerate("xyz"):
        table[name] = P[:, column]
    table["rgb"] = COLOURS
    return (HEADER + "DATA binary\n").encode() + table.tobytes()


def ascii_text() -> bytes:
    rows = [
        " ".join(str(v) for v in (*p, 0, 0, 0, 0, colour, 7))
        for p, colour in zip(P, COLOURS, strict=True)
    ]
    return (HEADER + "DATA ascii\n" + "\n".join(rows) + "\n").encode()


@pytest.mark.parametrize("data", [binary(), ascii_text()], ids=["binary", "ascii"])
def test_points_and_colours_are_read_and_nan_left_out(data: bytes) -> None:
    cloud = parse_pcd(data, "cloud.pcd")
    np.testing.assert_array_equal(cloud.p, P[[0, 2]])
    np.testing.assert_array_equal(cloud.colours, [[10, 20, 30], [255, 0, 128]])
    assert cloud.intensity is None


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "not a PCD file"),
        (binary()[:-3], "end early"),
        (ascii_text()[:-30], "end early"),
        (binary().replace(b"DATA binary", b"DATA binary_compressed"), "compressed PCD"),
        (binary().replace(b"DATA binary", b"DATA other"), "DATA ascii or"),
        (binary().replace(b"POINTS 3", b"POINTS x"), "number of POINTS"),
        (binary().replace(b"POINTS 3", b"POINTS 999999999999"), "take fewer"),
        (binary().replace(b"FIELDS x y z", b"FIELDS x y w"), "x, y, z"),
        (binary().replace(b"SIZE 4 4 4", b"SIZE 4 4"), "differ"),
        (binary().replace(b"TYPE F", b"TYPE Q"), "differ"),
    ],
)
def test_damaged_files_are_refused_in_one_line(data: bytes, message: str) -> None:
    with pytest.raises(MapError, match=message) as error:
        parse_pcd(data, "cloud.pcd")
    assert str(error.value).startswith("cloud.pcd: ")
    assert "\n" not in str(error.value)


CORNERS = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 3.0]])
FACES = np.array([[0, 2, 1], [0, 1, 3]], dtype=np.int32)


def test_obj(tmp_path: Path) -> None:
    write_mesh(CORNERS, FACES, tmp_path / "mesh.obj")
    text = (tmp_path / "mesh.obj").read_text()
    words = [line.split() for line in text.splitlines() if line]
    vertices = [list(map(float, line[1:])) for line in words if line[0] == "v"]
    np.testing.assert_array_equal(vertices, CORNERS)
    faces = [list(map(int, line[1:])) for line in words if line[0] == "f"]
    np.testing.assert_array_equal(faces, FACES + 1)


def test_stl(tmp_path: Path) -> None:
    write_mesh(CORNERS, FACES, tmp_path / "mesh.stl")
    data = (tmp_path / "mesh.stl").read_bytes()
    assert len(data) == 84 + 50 * len(FACES)
    assert int.from_bytes(data[80:84], "little") == len(FACES)
    numbers = np.frombuffer(data[84:134], dtype="<f4", count=12).reshape(4, 3)
    np.testing.assert_array_equal(numbers[0], [0.0, 0.0, -1.0])
    np.testing.assert_array_equal(numbers[1:], CORNERS[FACES[0]])


def test_glb(tmp_path: Path) -> None:
    write_mesh(CORNERS, FACES, tmp_path / "mesh.glb")
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
    np.testing.assert_array_equal(
        positions, np.stack([CORNERS[:, 0], CORNERS[:, 2], -CORNERS[:, 1]], axis=1)
    )
    start = views[1]["byteOffset"]
    indices = np.frombuffer(body, dtype="<u4", count=6, offset=start).reshape(-1, 3)
    np.testing.assert_array_equal(indices, FACES)
    assert place["max"] == [1.0, 3.0, 0.0]
    assert len(data) % 4 == 0


def test_other_formats_and_existing_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"\.ply, \.obj, \.stl, \.glb"):
        write_mesh(CORNERS, FACES, tmp_path / "mesh.fbx")
    write_mesh(CORNERS, FACES, tmp_path / "mesh.stl")
    with pytest.raises(UserError, match="--overwrite"):
        write_mesh(CORNERS, FACES, tmp_path / "mesh.stl")


@pytest.mark.parametrize("kind", ["ply", "obj", "stl", "glb"])
def test_every_format_reads_back(kind: str, tmp_path: Path) -> None:
    colours = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [10, 20, 30]], dtype=np.uint8)
    path = tmp_path / f"mesh.{kind}"
    write_mesh(CORNERS, FACES, path, colours)
    read = read_mesh(path)
    assert read.faces is not None
    np.testing.assert_allclose(read.p[read.faces], CORNERS[FACES], atol=1e-7)
    if kind == "stl":
        assert read.colours is None
    else:
        assert read.colours is not None
        np.testing.assert_array_equal(read.colours[read.faces], colours[FACES])


@pytest.mark.parametrize("kind", ["ply", "obj", "stl", "glb"])
def test_damaged_meshes_are_refused_by_name(kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"mesh.{kind}"
    write_mesh(CORNERS, FACES, path)
    data = path.read_bytes()
    for cut in (b"", b"\xff\xfe", data[: len(data) // 4]):
        path.write_bytes(cut)
        with pytest.raises(MapError, match=rf"mesh\.{kind}"):
            read_mesh(path)
