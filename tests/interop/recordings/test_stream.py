"""Synchronisation of cameras, against all pairs of stamps."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplab_py.array_types import I64
from maplab_py.interop.recordings.protocol import CameraImage, Event, FrameSet, ImuBatch
from maplab_py.interop.recordings.stream import Synchroniser
from tests.interop.recordings.written import assert_in_order

NO_DATA: Any = None


def _images(*stamps_of_cameras: list[int]) -> list[CameraImage]:
    images = [
        CameraImage(camera, stamp, stamp, NO_DATA)
        for camera, stamps in enumerate(stamps_of_cameras)
        for stamp in stamps
    ]
    return sorted(images, key=lambda image: (image.time_ns, image.camera))


def _batch(times_ns: I64) -> ImuBatch:
    count = len(times_ns)
    return ImuBatch(times_ns, np.zeros((count, 6)), np.zeros(count, dtype=np.bool_))


def _run(synchroniser: Synchroniser, items: list[Any]) -> list[Event]:
    events = [event for item in items for event in synchroniser.push(item)]
    return events + list(synchroniser.finish())


def test_images_within_the_tolerance_are_put_together() -> None:
    synchroniser = Synchroniser(2, 3)
    sets = _run(synchroniser, _images([0, 100, 200, 300], [2, 104, 197, 400]))
    pairs = [[image.time_ns for image in s.images] for s in sets if isinstance(s, FrameSet)]
    assert pairs == [[0, 2], [200, 197]]
    assert synchroniser.unmatched == [2, 2]
    assert [s.time_ns for s in sets if isinstance(s, FrameSet)] == [0, 200]


def test_a_camera_that_stops_does_not_hold_the_imu_back() -> None:
    synchroniser = Synchroniser(2, 3)
    (image,) = _images([50], [])
    events = _run(synchroniser, [image, _batch(np.array([51, 52])), _batch(np.array([60, 70]))])
    assert [event.time_ns for event in events] == [51, 60]
    assert synchroniser.unmatched == [1, 0]


@given(
    first=st.lists(st.integers(1, 40), min_size=1, max_size=12),
    jitter=st.lists(st.integers(-6, 6), min_size=12, max_size=12),
    missing=st.sets(st.integers(0, 11)),
)
def test_every_image_is_in_a_set_or_counted(
    first: list[int], jitter: list[int], missing: set[int]
) -> None:
    tolerance = 4
    stamps = (np.cumsum(np.array(first) + 20)).tolist()  # further apart than twice the tolerance
    other = [
        s + j for row, (s, j) in enumerate(zip(stamps, jitter, strict=False)) if row not in missing
    ]
    other = sorted(set(other))
    images = _images(stamps, other)
    end = max(stamps + other) + 10
    items: list[Any] = []
    last = 0
    for image in images:  # samples at every time, those up to an image before it
        if image.time_ns > last:
            items.append(_batch(np.arange(last + 1, image.time_ns + 1)))
            last = image.time_ns
        items.append(image)
    items.append(_batch(np.arange(last + 1, end + 1)))
    synchroniser = Synchroniser(2, tolerance)
    events = _run(synchroniser, items)
    sets = [event for event in events if isinstance(event, FrameSet)]
    expected = [(s, o) for s in stamps for o in other if abs(s - o) <= tolerance]
    assert [(s.images[0].time_ns, s.images[1].time_ns) for s in sets] == expected
    assert synchroniser.unmatched == [len(stamps) - len(sets), len(other) - len(sets)]
    samples = [event.times_ns for event in events if isinstance(event, ImuBatch)]
    np.testing.assert_array_equal(np.concatenate(samples), np.arange(1, end + 1))
    assert_in_order(events)


@pytest.mark.parametrize("cameras", [1, 3])
def test_other_numbers_of_cameras(cameras: int) -> None:
    stamps = [list(range(0, 1000, 100))] * cameras
    sets = _run(Synchroniser(cameras, 0), _images(*stamps))
    assert [s.time_ns for s in sets] == stamps[0]
