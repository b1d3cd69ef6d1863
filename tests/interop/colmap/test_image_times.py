"""Times of images from names."""

from __future__ import annotations

from pathlib import Path

import pytest

from maplab_py.errors import MapError, UserError
from maplab_py.interop.colmap.importing import image_times, read_times


@pytest.mark.parametrize(
    ("names", "times_ns"),
    [
        (("cam0/1403715273262142976.jpg",), [1403715273262142976]),
        (
            ("left_1403715273262143.png", "left_1403715273312143.png"),
            [1403715273262143000, 1403715273312143000],
        ),
        (("1403715273312.png", "1403715273262.png"), [1403715273312000000, 1403715273262000000]),
        (("a/1403715273.262142976.png",), [1403715273262142976]),
        (("frame_12.5.png", "frame_12.75.png"), [12_500_000_000, 12_750_000_000]),
        (("600000000000.png", "600050000000.png"), [600_000_000_000, 600_050_000_000]),
    ],
)
def test_stamps_in_names(names: tuple[str, ...], times_ns: list[int]) -> None:
    assert image_times(names, "name", None, interval_s=1.0).tolist() == times_ns


def test_the_unit_of_one_number_is_not_guessed() -> None:
    names = ("left_1403715273262143.png",)
    with pytest.raises(MapError, match="--time_unit"):
        image_times(names, "name", None, interval_s=1.0)
    assert image_times(names, "name", None, interval_s=1.0, time_unit="us").tolist() == [
        1403715273262143000
    ]


def test_cameras_of_a_rig_that_are_microseconds_apart() -> None:
    names = tuple(
        f"cam{c}/{600_000_000_000 + 50_000_000 * k + 900 * c}.png" for k in range(4) for c in (0, 1)
    )
    times_ns = image_times(names, "name", None, interval_s=1.0)
    assert times_ns[:3].tolist() == [600_000_000_000, 600_000_000_900, 600_050_000_000]


def test_a_file_of_stamps(tmp_path: Path) -> None:
    file = tmp_path / "times.txt"
    file.write_text("# name, time [ms]\nImage 1.png, 1000.5\nb.png 1033.5\n")
    assert read_times(file) == {"Image 1.png": 1_000_500_000, "b.png": 1_033_500_000}
    file.write_text("a.png later\n")
    with pytest.raises(MapError, match=":1: wants an image name and a time stamp"):
        read_times(file)


@pytest.mark.parametrize("name", ["image.png", "cam0/000123.png", "1" * 25 + ".png"])
def test_names_without_stamp_are_refused(name: str) -> None:
    with pytest.raises(UserError, match="has no time stamp"):
        image_times((name,), "name", None, interval_s=1.0)


def test_frames_share_the_time_of_their_order() -> None:
    names = ("left/2.png", "right/1.png", "left/1.png")
    assert image_times(names, "order", None, interval_s=2.0).tolist() == [4e9, 2e9, 2e9]
