"""Tables of images and IMU samples as other programs and people leave them."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from maplab_py.errors import MapError, UserError
from maplab_py.interop.recordings import stream, summary
from maplab_py.interop.recordings.reader_choice import open_recording
from tests.interop.recordings.written import assert_content, make_content, write_folder

CONTENT = make_content(cameras=1, frames=12)
HEADER = "#timestamp [ns],filename"


def edited(tmp_path: Path, table: str, edit: Callable[[list[str]], list[str]], **kind: str) -> Path:
    """Write a recording of which the rows of a table are edited, without its header."""
    folder = write_folder(CONTENT, tmp_path / "room")
    path = folder / "mav0" / table / "data.csv"
    header, *rows = path.read_text().splitlines()
    text = "\n".join([kind.get("header", header), *edit(rows), ""])
    path.write_bytes(text.encode(kind.get("encoding", "utf-8")))
    return folder


def each(pattern: str) -> Callable[[list[str]], list[str]]:
    """Rows of another form, which may name t, name, s, ns and k."""

    def edit(rows: list[str]) -> list[str]:
        cells = [row.split(",") for row in rows]
        return [
            pattern.format(t=t, name=name, s=t[:-9], ns=t[-9:], k=k)
            for k, (t, name) in enumerate(cells)
        ]

    return edit


@pytest.mark.parametrize(
    ("header", "row"),
    [
        (HEADER, "{t},data\\{name}"),
        (HEADER, "{t},./cam0/data/{name}"),
        (HEADER, "{t},/home/me/room/mav0/cam0/data/{name}"),
        ("time [ns];file", "{t};{name}"),
        ("time\tfile", "{s}.{ns}\t{name}"),
        ("filename,timestamp [ns]", "{name},{t}"),
        ("id,timestamp,filename", "{k},{t},{name}"),
        ("#timestamp [ns],filename,exposure [s]", "{t},{name},0.005"),
        ("# Gerät\n" + HEADER, "{t},{name}"),
    ],
)
def test_tables_of_images(tmp_path: Path, header: str, row: str) -> None:
    folder = edited(tmp_path, "cam0", each(row), header=header, encoding="latin-1")
    assert_content(list(stream.EventStream(open_recording(folder))), CONTENT)


@pytest.mark.parametrize("row", ["{t},cam1/data/{name}", "{t},../data/{name}", "{t},{name},0.005"])
def test_rows_that_name_no_image_of_the_camera(tmp_path: Path, row: str) -> None:
    with pytest.raises(MapError, match=r"data.csv:2: a row must be a time stamp and the name"):
        open_recording(edited(tmp_path, "cam0", each(row)))


@pytest.mark.parametrize("table", ["cam0", "imu0"])
@pytest.mark.parametrize("order", ["reversed", "as text", "shuffled"])
def test_unsorted_rows_are_sorted(tmp_path: Path, table: str, order: str) -> None:
    def edit(rows: list[str]) -> list[str]:
        places = {
            "reversed": np.arange(len(rows))[::-1],
            "as text": np.argsort([row.split(",")[0][::-1] for row in rows]),
            "shuffled": np.random.default_rng(2).permutation(len(rows)),
        }
        return [rows[place] for place in places[order]]

    recording = open_recording(edited(tmp_path, table, edit))
    assert_content(list(stream.EventStream(recording)), CONTENT)
    assert recording.notes[0].endswith(
        f"{table}/data.csv: rows are not in the order of time: they are sorted"
    )


def test_a_repeated_table_is_no_unsorted_one(tmp_path: Path) -> None:
    folder = edited(tmp_path, "cam0", lambda rows: rows + rows)
    assert summary.summarise(open_recording(folder)).notes[0].startswith("the clock starts again")


def test_images_with_something_behind_their_end(tmp_path: Path) -> None:
    folder = write_folder(CONTENT, tmp_path / "room", suffix=".jpg")
    file = next((folder / "mav0/cam0/data").iterdir())
    pixels, whole = cv2.imread(str(file), cv2.IMREAD_UNCHANGED), file.read_bytes()
    file.write_bytes(whole + b"\0\0\0\x18ftypmp42" + bytes(5000))
    images = {
        image.stamp_ns: image for image in open_recording(folder).items() if hasattr(image, "data")
    }
    np.testing.assert_array_equal(images[int(file.stem)].decode(), pixels)
    file.write_bytes(whole[:-200])
    with pytest.raises(MapError, match="truncated"):
        images[int(file.stem)].decode()


def test_what_the_user_may_have_meant(tmp_path: Path) -> None:
    folder = write_folder(CONTENT, tmp_path / "room")
    for path in ("mav0/cam0", "mav0/imu0/data.csv"):
        with pytest.raises(UserError, match=rf"it is a part of {folder}/mav0$"):
            open_recording(folder / path)
    (tmp_path / "room.ZIP").write_bytes(b"PK")
    with pytest.raises(UserError, match="it is an archive: unpack it first"):
        open_recording(tmp_path / "room.ZIP")


def test_images_without_partner_are_noted_of_either_camera(tmp_path: Path) -> None:
    content = make_content(frames=20)
    folder = write_folder(content, tmp_path / "room")
    (folder / "mav0/imu1").mkdir()
    table = folder / "mav0/cam1/data.csv"
    table.write_text("\n".join(table.read_text().splitlines()[:2]) + "\n")
    notes = " | ".join(
        note.replace("0.001", "") for note in summary.summarise(open_recording(folder)).notes
    )
    assert "imu1: not read: the IMU is imu0" in notes
    assert "of 20 images of camera 0 have no partner in camera 1" in notes
