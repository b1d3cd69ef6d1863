"""PCD files: ascii and binary, columns of every type, damaged ones."""

from __future__ import annotations

import numpy as np
import pytest

from maplab_py.errors import MapError
from maplab_py.interop.pcd import parse_pcd

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
