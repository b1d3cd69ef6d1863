"""Files from outside are bounded before anything is allocated; output is complete or not there."""

import gzip
import io
import json
import os
import stat
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maplab_py.algorithms.loop_closure.closure_record import FIELD_NUMBER, read_record
from maplab_py.algorithms.self_calibration.segments.database import load_database
from maplab_py.console.commands.flags import read_flagfile
from maplab_py.console.scripts.aliases import read_aliases
from maplab_py.console.scripts.batch import read_batch, read_script
from maplab_py.errors import MapError, UserError
from maplab_py.input_files import TooLarge, inflate, inflated_size, read_bytes, read_npz
from maplab_py.interop import external_closures, ply
from maplab_py.output_files import check_writable, planning, staging, write_bytes, write_text
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.storage.extension_fields import PACKED, with_extension
from maplab_py.storage.native import load_map, save_map
from maplab_py.vision.projection import load_projection
from tests.storage.damaging import alias_bomb
from tests.vimap.builders import walk_map


def npz(shape: tuple[int, ...], size: int, dtype: str = "<f4") -> bytes:
    """Return an archive whose matrix says one size and has another."""
    content, entry = io.BytesIO(), io.BytesIO()
    header = {"descr": dtype, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(entry, header)
    entry.write(bytes(size))
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("matrix.npy", entry.getvalue())
        archive.writestr("header.npy", entry.getvalue())
    return content.getvalue()


@pytest.mark.parametrize("wbits", [15, 31])
@pytest.mark.parametrize("size", [0, 1, 4095, 4096, (1 << 20) - 1, 1 << 20, 3_000_001])
def test_streams_are_unpacked_up_to_the_bound(wbits: int, size: int) -> None:
    plain = np.random.default_rng(size).integers(0, 4, size, dtype=np.uint8).tobytes()
    packed = zlib.compress(plain) if wbits == 15 else gzip.compress(plain)
    for rest in (b"", b"x", bytes(5000)):
        assert inflate(packed + rest, size, wbits=wbits) == (plain, len(packed))
        assert inflated_size(packed + rest, size, wbits=wbits) == size
    if size:
        with pytest.raises(TooLarge):
            inflate(packed, size - 1, wbits=wbits)
        assert inflated_size(packed, size - 1, wbits=wbits) == size
    for end in (0, 5, len(packed) - 1):
        with pytest.raises(EOFError):
            inflate(packed[:end], size, wbits=wbits)


def test_files_are_read_up_to_the_bound(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"12345")
    assert read_bytes(tmp_path / "a", 5) == b"12345"
    with pytest.raises(UserError, match=r"a: is larger than 4e-06 MB; raise --proto_max"):
        read_bytes(tmp_path / "a", 4)
    with pytest.raises(UserError, match="is larger than 1 MB"):
        read_bytes(Path("/dev/zero"), 1_000_000)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "not an .npz file"),
        (npz((2, 8), 64)[:-30], "not an .npz file"),
        (npz((10**9, 10**9), 64), "bytes for"),
        (npz((-1, 8), 64), "bytes for"),
        (npz((2, 8), 64, "|O"), "Python objects"),
    ],
)
def test_archives_that_are_none_are_refused(tmp_path: Path, content: bytes, said: str) -> None:
    path = tmp_path / "a.npz"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=said):
        read_npz(path)
    with pytest.raises(UserError, match=r"a\.npz is not a projection"):
        load_projection(path)
    with pytest.raises(UserError, match=r"a\.npz is damaged or not a segment database"):
        load_database(path)


def test_archives_are_bounded(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    path.write_bytes(npz((17_000_000,), 68_000_000))
    assert path.stat().st_size < 200_000
    for read in (load_projection, lambda file: load_database(file, 60_000_000)):
        with pytest.raises(UserError, match=r"a\.npz: unpacks to more than 6. MB; raise --proto"):
            read(path)


def _recorded(folder: Path, plain: bytes) -> Any:
    vi_map = walk_map()
    unknown = vi_map.missions.unknown.copy()
    unknown[0] = with_extension(b"", FIELD_NUMBER, PACKED + zlib.compress(plain))
    vi_map = vi_map.replace(missions=vi_map.missions.replace(unknown=unknown))
    save_map(vi_map, folder)
    return vi_map


def test_a_bomb_in_the_record_of_closures_is_refused_at_load(tmp_path: Path) -> None:
    _recorded(tmp_path / "map", bytes(11_000_000))
    with pytest.raises(MapError, match=r"missions: mission [0-9a-f]{32}: its record of loop clos"):
        load_map(tmp_path / "map", max_size_megabytes=40)
    assert load_map(tmp_path / "map", max_size_megabytes=50)[1].notes == []


@pytest.mark.parametrize(
    "plain",
    [
        b"",
        (200_000).to_bytes(4, "little") + b"[" * 200_000,
        (90_000).to_bytes(4, "little") + b"[" * 90_000,
        b"\x30\0\0\0" + json.dumps([["closures", "id", "<u8", [10**9, 10**9]]]).encode(),
        b"\x28\0\0\0" + json.dumps([["closures", "id", "<u8", [-1, 2]]]).encode(),
    ],
)
def test_a_damaged_record_of_closures_is_told(tmp_path: Path, plain: bytes) -> None:
    vi_map = _recorded(tmp_path / "map", plain)
    with pytest.raises(MapError, match=r"the record of loop closures is damaged .*_record drops"):
        read_record(vi_map)


@pytest.mark.parametrize(
    "read",
    [
        read_batch,
        load_scenario,
        lambda path: external_closures.read_external_closures(walk_map(), path),
    ],
)
def test_alias_bombs_are_refused(tmp_path: Path, read: Callable[[Path], object]) -> None:
    path = tmp_path / "bomb.yaml"
    path.write_text(alias_bomb(12))
    with pytest.raises(UserError, match=r"bomb\.yaml") as error:
        read(path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("read", [read_script, read_flagfile, read_aliases, load_scenario])
def test_files_that_people_write_are_bounded(
    tmp_path: Path, read: Callable[[Path], object]
) -> None:
    path = tmp_path / "long"
    with path.open("wb") as file:
        file.truncate(17_000_000)
    with pytest.raises(UserError, match=r"long: is larger than 16 MB"):
        read(path)


@pytest.mark.parametrize(
    ("header", "said"),
    [
        ("element vertex 99999999999\nproperty float x", "more than"),
        ("element vertex -1\nproperty float x", "wrong line"),
        ("element vertex 5\nproperty float x\nproperty float y\nproperty float z", "end early"),
        ("comment " + "x" * 200_000, "not a PLY file"),
    ],
)
def test_ply_files_are_bounded(header: str, said: str) -> None:
    text = f"ply\nformat binary_little_endian 1.0\n{header}\nend_header\n"
    with pytest.raises(MapError, match=said):
        ply.parse_ply(text.encode(), "a.ply")


def test_text_is_written_as_it_is_given(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a.txt"
    write_text(path, ["één\r\n", "2\n"])
    assert path.read_bytes() == "één\r\n2\n".encode()
    before = os.umask(0o027)
    try:
        write_bytes(tmp_path / "b", [b"1", b"2"])
    finally:
        os.umask(before)
    assert (tmp_path / "b").read_bytes() == b"12"
    assert stat.S_IMODE((tmp_path / "b").stat().st_mode) == 0o640


def test_nothing_is_replaced_unasked(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(UserError, match=r"a\.txt exists already: give --overwrite"):
        write_text(path, ["new"])
    assert path.read_text() == "old"
    write_text(path, ["new"], overwrite=True)
    assert path.read_text() == "new"
    with pytest.raises(UserError, match="is a folder: name a file"):
        check_writable(tmp_path, overwrite=True)


def test_a_failure_leaves_the_old_file_and_no_other(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")

    def chunks() -> Iterator[str]:
        yield "half"
        raise RuntimeError

    with pytest.raises(RuntimeError):
        write_text(path, chunks(), overwrite=True)
    assert path.read_text() == "old"
    assert [file.name for file in tmp_path.iterdir()] == ["a.txt"]
    with pytest.raises(UserError, match=r"cannot be written \(.*a\.txt is not a folder\)"):
        write_text(path / "below", ["x"])


def test_planned_files_are_checked_and_noted(tmp_path: Path) -> None:
    old, new = tmp_path / "old.txt", tmp_path / "folder" / "new.bin"
    old.write_text("old")
    with planning() as planned:
        write_text(old, ["12", "345"], overwrite=True)
        write_bytes(new, [bytes(2000)])
        with pytest.raises(UserError, match="exists already"):
            write_text(old, ["x"])
    assert [str(file) for file in planned] == [
        f"would replace {old} (5 bytes)",
        f"would write {new} (2,000 bytes)",
    ]
    assert old.read_text() == "old"
    assert not new.parent.exists()
    write_text(new, ["now"])
    assert new.read_text() == "now"


def test_a_staged_file_that_fails_is_not_published_with_the_others(tmp_path: Path) -> None:
    def chunks() -> Iterator[str]:
        yield "half"
        raise UserError("half a file")

    with staging() as staged:
        write_text(tmp_path / "first", ["1"])
        with pytest.raises(UserError, match="half a file"):
            write_text(tmp_path / "new" / "second", chunks())
        write_text(tmp_path / "first", ["2"])
        assert [path.name for path in tmp_path.iterdir()] == [".first.saving"]
        staged.publish()
    assert [path.name for path in tmp_path.iterdir()] == ["first"]
    assert (tmp_path / "first").read_text() == "2"
