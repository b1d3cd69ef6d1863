"""Times of images from names."""

from __future__ import annotations

import pytest

from maplab_py.errors import UserError
from maplab_py.interop.colmap.image_times import image_times


@pytest.mark.parametrize(
    ("name", "time_ns"),
    [
        ("cam0/1403715273262142976.jpg", 1403715273262142976),
        ("left_1403715273262143.png", 1403715273262143000),
        ("1403715273262.png", 1403715273262000000),
        ("a/1403715273.262142976.png", 1403715273262142976),
        ("frame_12.5.png", 12_500_000_000),
    ],
)
def test_units_follow_from_the_digits(name: str, time_ns: int) -> None:
    assert image_times((name,), "name", None, interval_s=1.0).tolist() == [time_ns]


@pytest.mark.parametrize("name", ["image.png", "cam0/000123.png", "1" * 25 + ".png"])
def test_names_without_stamp_are_refused(name: str) -> None:
    with pytest.raises(UserError, match="has no time stamp"):
        image_times((name,), "name", None, interval_s=1.0)


def test_frames_share_the_time_of_their_order() -> None:
    names = ("left/2.png", "right/1.png", "left/1.png")
    assert image_times(names, "order", None, interval_s=2.0).tolist() == [4e9, 2e9, 2e9]
