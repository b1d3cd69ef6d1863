"""Replay of missions of maps."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from maplab_py.errors import MapError
from maplab_py.interop.recordings.map_replay import MapRecording
from maplab_py.interop.recordings.options import StreamOptions
from maplab_py.interop.recordings.protocol import TrackedFrameSet
from maplab_py.interop.recordings.stream import EventStream
from maplab_py.interop.recordings.summary import summarise
from maplab_py.storage.native import load_map
from tests.interop.recordings.written import assert_in_order, samples
from tests.interop.small_map import START_NS, VERTICES, make_map
from tests.support.data import shared_data


@pytest.mark.parametrize("mission", [0, 1])
def test_a_mission_reads_back(mission: int) -> None:
    vi_map = make_map()
    recording = MapRecording(vi_map, mission)
    events = list(EventStream(recording))
    assert_in_order(events)
    sets = [event for event in events if isinstance(event, TrackedFrameSet)]
    rows = slice(mission * VERTICES, (mission + 1) * VERTICES)
    assert [s.time_ns for s in sets] == vi_map.vertices.timestamp_ns[rows].tolist()
    frames = [s.frames[0] for s in sets]
    keypoints = slice(mission * 24, (mission + 1) * 24)
    for name in ("uv_px", "sigma_px", "track_id", "scale", "descriptor"):
        read = np.concatenate([getattr(frame, name) for frame in frames])
        np.testing.assert_array_equal(read, getattr(vi_map.keypoints, name)[keypoints])
    assert {int(size) for frame in frames for size in frame.descriptor_size} == {(48, 3)[mission]}
    times_ns, accel_gyro = samples(events)
    first = START_NS + mission * 10**11
    assert times_ns.tolist() == list(range(first, first + (VERTICES - 1) * 500_000_000 + 1, 10**7))
    edges = slice(mission * (VERTICES - 1) * 51, mission * (VERTICES - 1) * 51 + 51)
    np.testing.assert_array_equal(accel_gyro[:51], vi_map.imu_samples.accel_gyro[edges])


def test_part_of_a_mission() -> None:
    recording = MapRecording(make_map(), 0)
    events = list(EventStream(recording, StreamOptions(start_s=0.5, end_s=1.5)))
    times_ns, _ = samples(events)
    assert (times_ns[0] - START_NS, times_ns[-1] - START_NS) == (500_000_000, 1_490_000_000)
    sets = [event for event in events if isinstance(event, TrackedFrameSet)]
    assert [s.time_ns - START_NS for s in sets] == [500_000_000, 1_000_000_000]


def test_missing_and_invalid_frames_are_none() -> None:
    vi_map = make_map()
    is_valid = np.ones(len(vi_map.frames), dtype=np.bool_)
    is_valid[1] = False
    vi_map = vi_map.replace(frames=vi_map.frames.replace(is_valid=is_valid))
    sets = [e for e in EventStream(MapRecording(vi_map, 0)) if isinstance(e, TrackedFrameSet)]
    assert [s.frames[0] is None for s in sets] == [False, True, False, False, False, False]


def test_what_cannot_be_replayed() -> None:
    vi_map = make_map()
    missions = vi_map.missions.replace(sensor_id=np.zeros_like(vi_map.missions.sensor_id))
    with pytest.raises(MapError, match="has no camera rig: choose another mission"):
        MapRecording(vi_map.replace(missions=missions), 0)
    times_ns = vi_map.imu_samples.timestamp_ns.copy()
    times_ns[60] -= 10**9
    table = dataclasses.replace(vi_map.imu_samples, timestamp_ns=times_ns)
    with pytest.raises(MapError, match=r"samples of IMU edge [0-9a-f]{32} run backwards"):
        MapRecording(vi_map.replace(imu_samples=table), 0)


def test_real_walk() -> None:
    vi_map, _ = load_map(shared_data("maplab_maps/tango_handheld"))
    assert len(vi_map.imu_samples) == 25_675
    recording = MapRecording(vi_map, 0)
    events = list(EventStream(recording))
    assert_in_order(events)
    sets = [event for event in events if isinstance(event, TrackedFrameSet)]
    assert len(sets) == 969
    times_ns, accel_gyro = samples(events)
    assert len(times_ns) == 25_675 - 967  # each of the 968 edges but the first repeats a sample
    kept = np.unique(vi_map.imu_samples.timestamp_ns, return_index=True)[1]
    np.testing.assert_array_equal(accel_gyro, vi_map.imu_samples.accel_gyro[kept])
    frames = [frame for s in sets for frame in s.frames if frame is not None]
    assert sum(len(frame.uv_px) for frame in frames) == 254_757
    assert all(np.all(frame.descriptor_size == 48) for frame in frames)
    report = summarise(recording)
    assert report.frame_sets == 969
    assert report.duration_s == pytest.approx(118.0, abs=1.0)
    assert report.frame_set_rate_hz == pytest.approx(8.2, abs=0.1)
