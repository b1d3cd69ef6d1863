"""Output files: complete or not at all, and planned without being written."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from pathlib import Path

import pytest

from maplab_py.errors import UserError
from maplab_py.output_files import check_writable, planning, staging, write_bytes, write_text


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
    with pytest.raises(UserError, match=r"cannot be written \((File exists|Not a directory)\)"):
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
