"""PLY files in all three encodings."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import MapError
from maplab_py.interop.ply import PlyCloud, parse_ply, write_ply
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
