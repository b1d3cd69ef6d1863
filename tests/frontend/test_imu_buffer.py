"""Samples cut and interpolated at the times of frames."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplab_py.errors import MapError
from maplab_py.frontend.imu_buffer import ImuBuffer
from maplab_py.interop.recordings.protocol import ImuBatch

STEP_NS = 5_000_000


def batch(times_ns: np.ndarray) -> ImuBatch:
    """Return samples that are linear in time, so that interpolation is exact."""
    accel_gyro = times_ns[:, None] * 1e-9 * np.arange(1.0, 7.0)
    return ImuBatch(times_ns, accel_gyro, np.zeros(len(times_ns), dtype=np.bool_))


def test_intervals_join_without_gap() -> None:
    buffer = ImuBuffer()
    buffer.push(batch(np.arange(0, 41) * STEP_NS))
    frames = [3_000_000, 50_000_000, 100_000_000, 151_234_567]
    parts = [buffer.cut(a, b) for a, b in itertools.pairwise(frames)]
    for part, a, b in zip(parts, frames[:-1], frames[1:], strict=True):
        assert (part.times_ns[0], part.times_ns[-1]) == (a, b)
        assert np.all(np.diff(part.times_ns) > 0)
        expected = part.times_ns[:, None] * 1e-9 * np.arange(1.0, 7.0)
        np.testing.assert_allclose(part.accel_gyro, expected, atol=1e-12)
        assert part.largest_step_ns == STEP_NS
        assert part.duration_s == pytest.approx((b - a) * 1e-9)
    np.testing.assert_array_equal(parts[0].accel_gyro[-1], parts[1].accel_gyro[0])
    assert len(parts[1].times_ns) == 11  # 50, 55, ..., 100 ms: nothing is interpolated
    assert buffer.first_ns == 0  # frames may turn out to be earlier than their stamps
    buffer.push(batch(np.arange(41, 101) * STEP_NS))
    buffer.cut(frames[-1], 453_000_000)
    assert buffer.first_ns == 150_000_000


@given(
    sizes=st.lists(st.integers(1, 9), min_size=1, max_size=12),
    frames=st.lists(st.integers(0, 500_000_000), min_size=2, max_size=6, unique=True),
)
def test_splitting_batches_does_not_change_intervals(sizes: list[int], frames: list[int]) -> None:
    times_ns = np.arange(0, 101) * STEP_NS
    whole, split = ImuBuffer(), ImuBuffer()
    whole.push(batch(times_ns))
    cuts = np.minimum(np.cumsum(sizes), len(times_ns))
    for part in np.split(times_ns, cuts):
        if len(part):
            split.push(batch(part))
    ordered = sorted(frames)
    for a, b in itertools.pairwise(ordered):
        left, right = whole.cut(a, b), split.cut(a, b)
        np.testing.assert_array_equal(left.times_ns, right.times_ns)
        np.testing.assert_array_equal(left.accel_gyro, right.accel_gyro)


def test_gaps_are_seen_by_the_interval_that_needs_them() -> None:
    times_ns = np.concatenate([np.arange(0, 10), np.arange(30, 41)]) * STEP_NS
    buffer = ImuBuffer()
    buffer.push(batch(times_ns))
    quiet = buffer.cut(0, 20_000_000)
    assert quiet.largest_step_ns == STEP_NS
    gap = buffer.cut(20_000_000, 160_000_000)
    assert gap.largest_step_ns == 21 * STEP_NS


def test_wrong_samples_are_refused_in_a_line_and_change_nothing() -> None:
    buffer = ImuBuffer()
    buffer.push(batch(np.arange(0, 3) * STEP_NS))
    late = np.array([10_000_000, 15_000_000])
    with pytest.raises(MapError, match=r"10000000 ns does not come after .* in the order"):
        buffer.push(batch(late))
    wrong = batch(late + STEP_NS)
    wrong.accel_gyro[1, 3] = np.nan
    with pytest.raises(MapError, match="20000000 ns has a value that is not a number"):
        buffer.push(wrong)
    assert buffer.last_ns == 2 * STEP_NS
    buffer.push(batch(late + STEP_NS))
    assert buffer.last_ns == 20_000_000
