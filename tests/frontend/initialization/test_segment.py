"""The latest frames: joined samples, gaps, and what is kept."""

import numpy as np

from maplab_py.estimation.window.frame import WindowFrame
from maplab_py.frontend.initialization.segment import History
from tests.frontend.initialization.flights import device

STEP_NS = 50_000_000


def frame(number: int, first_sample_ns: int | None = None) -> WindowFrame:
    time_ns = number * STEP_NS
    begin_ns = time_ns - STEP_NS if first_sample_ns is None else first_sample_ns
    times_ns = np.arange(begin_ns, time_ns + 1, 5_000_000)
    values = np.tile(times_ns[:, None] * 1e-9, (1, 6))
    ids = np.arange(number, number + 3)
    return WindowFrame(
        time_ns, times_ns, values, np.zeros(3, np.int32), ids, np.ones((3, 2)) * number, np.ones(3)
    )


def filled(count: int, longest_s: float = 4.0) -> History:
    history = History(longest_s)
    for number in range(count):
        history.push(frame(number))
    return history


def test_old_frames_are_forgotten() -> None:
    history = filled(30, longest_s=1.0)
    assert len(history) == 21
    assert history.duration_s == 1.0
    assert [f.time_ns for f in history.latest(0.1)] == [27 * STEP_NS, 28 * STEP_NS, 29 * STEP_NS]


def test_all_samples_between_the_chosen_frames_are_kept_once() -> None:
    imu = device().imu
    assert imu is not None
    segment = filled(12).segment(imu, 0.2)
    assert segment.time_ns.tolist() == [k * STEP_NS for k in (3, 7, 11)]
    assert segment.time_ns[-1] - segment.time_ns[0] == 400_000_000
    for edge, (a, b) in enumerate(((3, 7), (7, 11))):
        times_ns, values = segment.samples(edge)
        assert times_ns.tolist() == list(range(a * STEP_NS, b * STEP_NS + 1, 5_000_000))
        np.testing.assert_array_equal(values[:, 0], times_ns * 1e-9)
    assert segment.track_id.tolist() == [3, 4, 5, 7, 8, 9, 11, 12, 13]
    assert segment.frame.tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2]
    between = segment.between
    assert between.time_ns.tolist() == [k * STEP_NS for k in (4, 5, 6, 8, 9, 10)]
    assert between.track_id.reshape(-1, 3)[:, 0].tolist() == [4, 5, 6, 8, 9, 10]
    assert between.frame.tolist() == np.repeat(np.arange(6), 3).tolist()
    times_ns, _ = filled(12).samples(0.1)
    assert times_ns.tolist() == list(range(9 * STEP_NS, 11 * STEP_NS + 1, 5_000_000))


def test_a_gap_in_the_samples_starts_again() -> None:
    history = filled(5)
    history.push(frame(6))  # frame 5 is missing
    assert len(history) == 1
    assert len(history.samples(1.0)[0]) == 0
    history.push(frame(7))
    history.push(frame(7))
    assert len(history) == 1
