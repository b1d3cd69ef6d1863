"""Tracks in the window."""

import dataclasses

import numpy as np

from maplab_py.estimation.window.tracks import Observations, Tracks


def observations(count: int, rng: np.random.Generator) -> Observations:
    integers = np.zeros(count, dtype=np.int32)
    ray = rng.standard_normal((count, 3))
    return Observations(
        np.zeros(count, dtype=np.int64), integers, integers, rng.uniform(0, 400, (count, 2)),
        np.full(count, 0.8), ray / np.linalg.norm(ray, axis=1, keepdims=True),
    )  # fmt: skip


def test_frames_together_are_as_if_added_one_by_one() -> None:
    rng = np.random.default_rng(3)
    counts = [12, 0, 7, 9]
    ids = [rng.choice(20, count, replace=False).astype(np.int64) for count in counts]
    frame = np.repeat(np.arange(len(counts), dtype=np.int32), counts)
    seen = dataclasses.replace(observations(sum(counts), rng), frame=frame)
    together, alone = Tracks(), Tracks()
    together.add(range(len(counts)), np.concatenate(ids), seen)
    for number, of_frame in enumerate(ids):
        alone.add(range(number, number + 1), of_frame, seen.take(frame == number))
    for name in ("id", "last_seen", "is_active", "is_landmark", "anchor_frame"):
        np.testing.assert_array_equal(getattr(together, name), getattr(alone, name))
    for name in ("row", "frame", "uv_px", "ray_C"):
        np.testing.assert_array_equal(
            getattr(together.observations, name), getattr(alone.observations, name)
        )
    assert np.count_nonzero(together.is_active) == counts[-1]
