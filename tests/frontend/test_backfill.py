"""Frames before the start: their states are found afterwards, and become vertices of the map."""

import dataclasses

import numpy as np
import pytest

from maplab_py.frontend.backfill import Backfill, WaitingFrames
from maplab_py.frontend.mapping import Mapping
from maplab_py.frontend.odometry import Odometry
from maplab_py.frontend.odometry_options import OdometryOptions
from maplab_py.frontend.run_options import RunOptions
from maplab_py.interop.recordings.map_replay import MapRecording
from maplab_py.vimap.consistency import check_consistency
from tests.frontend.simulated import position_errors, replayed
from tests.frontend.test_odometry import LateStart, events_of, pushed

LATE = 20


class StartAtTheEnd(LateStart):
    """Waits for some frames, and knows the state of the last of them."""

    def push(self, frame):  # type: ignore[no-untyped-def]
        self.waiting.append(frame)
        return None if len(self.waiting) <= self.frames else self.known.push(frame)


def late(known, frames: int = LATE) -> StartAtTheEnd:  # type: ignore[no-untyped-def]
    return StartAtTheEnd(known, frames)


@pytest.mark.parametrize("cameras", [1, 2])
def test_frames_before_the_start_are_read_backwards(cameras: int) -> None:
    device, events, known = events_of(cameras=cameras)
    updates = pushed(odometry := Odometry(device, make_starter=late(known)), events)
    found = [update.backfill for update in updates if update.backfill is not None]
    assert len(found) == 1
    assert odometry.finish_backfill() is None
    assert len(found[0].states) == LATE + 1
    np.testing.assert_array_equal(found[0].stamps_ns, [u.time_ns for u in updates[: LATE + 1]])
    errors = position_errors(known.truth, found[0].states.time_ns, found[0].states.T_M_I)
    assert errors.max() < 0.1
    speed = np.linalg.norm(found[0].states.v_M, axis=1)
    assert known.truth.v_R is not None
    assert np.abs(speed - np.linalg.norm(known.truth.v_R[: LATE + 1], axis=1)).max() < 0.1


def test_the_end_of_a_recording_ends_the_reading() -> None:
    device, events, known = events_of(cameras=2)
    odometry = Odometry(device, make_starter=late(known))
    updates = pushed(odometry, events[: len(events) // 3])
    rest: Backfill | None = None
    for event in events[len(events) // 3 :]:
        if updates[-1].state is not None:
            break
        updates += pushed(odometry, [event])
    rest = odometry.finish_backfill()
    assert rest is not None
    assert len(rest.states) == LATE + 1


def test_a_map_begins_with_the_first_image() -> None:
    vi_map, _ = replayed(cameras=2)
    _, _, known = events_of(cameras=2)
    maps = []
    for backfill in (True, False):
        odometry = OdometryOptions(backfill=backfill)
        options = dataclasses.replace(RunOptions(), odometry=odometry)
        mapping = Mapping(MapRecording(vi_map, 0), options, make_starter=late(known))
        mapping.run()
        assert mapping.builder is not None
        maps.append(mapping.builder.make_map())
    whole, short = maps
    first_ns = vi_map.vertices.timestamp_ns[0]
    assert whole.vertices.timestamp_ns[0] == first_ns < short.vertices.timestamp_ns[0]
    assert len(whole.vertices) == len(short.vertices) + LATE
    assert len(whole.imu_edges) == len(whole.vertices) - 1
    assert not check_consistency(whole).errors
    np.testing.assert_array_equal(whole.vertices.T_M_I[LATE:], short.vertices.T_M_I)


def test_waiting_frames_with_a_delay_keep_their_samples() -> None:
    device, events, known = events_of(cameras=1)
    starter = LateStart(known, 10)
    pushed(Odometry(device, make_starter=starter), events[:60])
    waiting = WaitingFrames()
    for frame in starter.waiting:
        waiting.push(frame.time_ns, frame, (np.zeros(0, dtype=np.int64), np.zeros((0, 6))))
    plain = list(waiting.frames)
    waiting.delay(7_000_000, (np.zeros(0, dtype=np.int64), np.zeros((0, 6))), 2e-3)
    assert len(waiting.frames) == len(plain) - 1  # no sample comes after the last
    for before, after in zip(plain[1:], waiting.frames[1:], strict=False):
        assert after.time_ns == before.time_ns + 7_000_000
        assert after.imu_times_ns[-1] == after.time_ns
        assert after.delay_s == 2e-3
        assert np.all(np.diff(after.imu_times_ns) > 0)
