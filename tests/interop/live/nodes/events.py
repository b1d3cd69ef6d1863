"""Frames and samples in the order in which a robot sends them; for nodes that have numpy alone."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np


def load(path: Path) -> list[tuple[int, int, Any]]:
    """Return (stamp_ns, camera or -1 = IMU, pixels or [ax ay az gx gy gz]) by their stamps."""
    with np.load(path) as arrays:
        samples = [
            (int(t), -1, row) for t, row in zip(arrays["imu_ns"], arrays["imu"], strict=True)
        ]
        images = []
        for camera in range(int(arrays["cameras"])):
            stamps, pixels = arrays[f"stamps_ns{camera}"], arrays[f"pixels{camera}"]
            images += [(int(t), camera, image) for t, image in zip(stamps, pixels, strict=True)]
    return sorted(samples + images, key=lambda event: event[:2])


def paced(events: list[tuple[int, int, Any]], rate: float) -> Iterator[tuple[int, int, Any]]:
    """Yield the events at a multiple of real time."""
    begin_s, first_ns = time.monotonic(), events[0][0]
    for stamp_ns, sensor, content in events:
        wait_s = begin_s + (stamp_ns - first_ns) * 1e-9 / rate - time.monotonic()
        if wait_s > 0.0:
            time.sleep(wait_s)
        yield stamp_ns, sensor, content


def wait_while_growing(received: list[Any], pause_s: float = 5.0, longest_s: float = 150.0) -> None:
    """Wait until nothing has been received for a while."""
    deadline_s = time.monotonic() + longest_s
    count = -1
    while len(received) != count and time.monotonic() < deadline_s:
        count = len(received)
        time.sleep(pause_s)
