"""PLY files in all three encodings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import MapError
from maplab_py.interop.ply import PlyCloud, parse_ply, read_ply, write_ply

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
    back = read_ply(tmp_path / "cloud.ply")
    np.testing.assert_allclose(back.p, cloud.p, rtol=1e-6)
    np.testing.assert_array_equal(back.colours, colours)
    np.testing.assert_allclose(back.intensity, cloud.intensity, rtol=1e-6)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"no ply", "not a PLY file"),
        (b"ply\nelement vertex 1\nend_header\n", "names no format"),
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


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(MapError, match=r"none.ply: cannot be read"):
        read_ply(tmp_path / "none.ply")
