"""Odometry on simulated tracks and samples: accuracy, rest, restarts, and wrong input."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from maplab_py.errors import FlagError, MapError
from maplab_py.estimation.window.frame import Motion, WindowFrame
from maplab_py.estimation.window.smoother import FixedLagSmoother
from maplab_py.frontend.image_delay import DelayMonitor
from maplab_py.frontend.odometry import Odometry
from maplab_py.frontend.odometry_options import HealthOptions, OdometryOptions
from maplab_py.frontend.odometry_update import OdometryUpdate
from maplab_py.frontend.starting import Start
from maplab_py.geometry import se3, so3
from maplab_py.interop.recordings.map_replay import MapRecording
from maplab_py.interop.recordings.protocol import Event, ImuBatch, RecordedSensors, TrackedFrameSet
from maplab_py.interop.recordings.stream import EventStream
from maplab_py.simulation.scenario import MotionOptions
from maplab_py.vimap.nav_state import NavState
from tests.estimation.window.recordings import scenario, simulated
from tests.frontend.known_start import KnownStart, updates_of
from tests.frontend.simulated import REST_FIRST, position_errors, replayed


def events_of(**changes: object) -> tuple[RecordedSensors, list[Event], KnownStart]:
    """Return sensors and events of a simulated mission, and a start at its truth."""
    vi_map, truth = replayed(**changes)  # type: ignore[arg-type]
    recording = MapRecording(vi_map, 0)
    return recording.device, list(EventStream(recording)), KnownStart(truth, with_biases=True)


def pushed(odometry: Odometry, events: list[Event]) -> list[OdometryUpdate]:
    return list(updates_of(odometry, events))


def states_of(updates: list[OdometryUpdate]) -> NavState:
    return NavState.stack([u.state for u in updates if u.state is not None])


@pytest.mark.parametrize("cameras", [1, 2])
def test_perfect_measurements_are_reproduced(cameras: int) -> None:
    device, events, start = events_of(cameras=cameras, is_perfect=True)
    updates = pushed(Odometry(device, make_starter=start), events)
    assert all(update.state is not None for update in updates)
    states = states_of(updates)
    assert len(states) == sum(isinstance(event, TrackedFrameSet) for event in events)
    assert position_errors(start.truth, states.time_ns, states.T_M_I).max() < 2e-3


@pytest.mark.parametrize("cameras", [1, 2])
def test_noisy_measurements(cameras: int) -> None:
    device, events, start = events_of(cameras=cameras)
    odometry = Odometry(device, make_starter=start)
    updates = pushed(odometry, events)
    states = states_of(updates)
    assert position_errors(start.truth, states.time_ns, states.T_M_I).max() < 0.1
    released = NavState.stack([u.released for u in updates if u.released is not None])
    final = NavState.stack([released, odometry.window_states()])
    assert len(np.unique(final.time_ns)) == len(final) == len(states)
    assert position_errors(start.truth, final.time_ns, final.T_M_I).max() < 0.1
    track_id, p_M = odometry.landmarks()
    assert len(track_id) == len(p_M) > 20
    assert {u.mission for u in updates} == {0}


@dataclasses.dataclass
class LateStart:
    """Starts some frames after that whose state it knows, as an attempt that takes several frames."""

    known: KnownStart
    frames: int
    reason: str = ""
    waiting: list[WindowFrame] = dataclasses.field(default_factory=list)

    def __call__(self, device: RecordedSensors) -> LateStart:
        return self

    def push(self, frame: WindowFrame) -> Start | None:
        # as the detector would say without biases and speed
        self.waiting.append(dataclasses.replace(frame, motion=Motion.RESTING))
        if len(self.waiting) <= self.frames:
            return None
        first, *later = self.waiting
        start = self.known.push(first)
        assert start is not None
        return Start(first, start.state, tuple(later))


def test_frames_that_came_during_a_start_are_used() -> None:
    device, events, known = events_of(cameras=1)
    starter = LateStart(known, 4)
    odometry = Odometry(device, make_starter=starter)
    updates = pushed(odometry, events)
    assert [update.state is None for update in updates[:5]] == [True] * 4 + [False]
    assert updates[4].interval is None
    assert odometry.starts == 1
    assert device.imu is not None
    smoother = FixedLagSmoother(device.cameras, device.T_I_C, device.imu, OdometryOptions().window)
    first, *later = starter.waiting
    start = known.push(first)
    assert start is not None
    smoother.start(first, start.state)
    for frame in later:
        expected = smoother.add(dataclasses.replace(frame, motion=Motion.MOVING))
    states = states_of(updates)
    np.testing.assert_array_equal(states.T_M_I[:1], expected.state.T_M_I)
    np.testing.assert_array_equal(states.v_M[:1], expected.state.v_M)
    assert position_errors(known.truth, states.time_ns, states.T_M_I).max() < 0.1


def test_batches_of_samples_do_not_change_results() -> None:
    device, events, start = events_of()
    whole = states_of(pushed(Odometry(device, make_starter=start), events))
    split: list[Event] = []
    for event in events:
        if isinstance(event, ImuBatch):
            split += [event.take(slice(row, row + 1)) for row in range(len(event))]
        else:
            split.append(event)
    late: list[Event] = [event for event in events if isinstance(event, TrackedFrameSet)]
    samples = [event for event in events if isinstance(event, ImuBatch)]
    for other in (split, [*late[:50], *samples, *late[50:]]):
        states = states_of(pushed(Odometry(device, make_starter=start), other))
        np.testing.assert_array_equal(states.T_M_I, whole.T_M_I)
        np.testing.assert_array_equal(states.accel_bias, whole.accel_bias)


def test_it_starts_by_itself_at_rest() -> None:
    device, events, start = events_of(phases=REST_FIRST)
    updates = pushed(Odometry(device), events)
    assert updates[0].state is None
    assert "of images" in updates[0].note
    first = next(update for update in updates if update.state is not None)
    assert (first.time_ns - updates[0].time_ns) * 1e-9 < 1.7
    assert first.motion is Motion.RESTING
    states = states_of(updates)
    # the start defines position and yaw: compare distances from the first position
    true = start.truth.T_R_B[np.searchsorted(start.truth.times_ns, states.time_ns), 4:]
    distance = np.linalg.norm(states.T_M_I[:, 4:] - states.T_M_I[0, 4:], axis=1)
    assert np.abs(distance - np.linalg.norm(true - true[0], axis=1)).max() < 0.1
    gravity_error = np.degrees(np.arccos(np.clip(cosine_of_tilts(states, start), -1, 1)))
    assert gravity_error.max() < 2.0  # at rest a bias of the accelerometer looks like a tilt
    assert gravity_error[-1] < 0.3


def cosine_of_tilts(states: NavState, start: KnownStart) -> np.ndarray:
    """Return the cosines of the angles between estimated and true gravity in the body."""
    rows = np.searchsorted(start.truth.times_ns, states.time_ns)
    up = np.array([0.0, 0.0, 1.0])
    estimated = so3.rotate(so3.inverse(states.T_M_I[:, :4]), up)
    expected = so3.rotate(so3.inverse(start.truth.T_R_B[rows, :4]), up)
    return np.sum(estimated * expected, axis=1)


@pytest.mark.parametrize("cameras", [1, 2])
def test_it_does_not_drift_at_rest(cameras: int) -> None:
    phases = (
        MotionOptions(kind="stationary", duration_s=1.5),
        MotionOptions(kind="room_scan", duration_s=5.0, turns=0.2),
        MotionOptions(kind="stationary", duration_s=8.0),
    )
    device, events, start = events_of(phases=phases, cameras=cameras)
    updates = pushed(Odometry(device, make_starter=start), events)
    end_ns = updates[-1].time_ns
    resting = [u for u in updates if u.time_ns > end_ns - 6_000_000_000]
    assert sum(u.motion is Motion.RESTING for u in resting) > 0.9 * len(resting)
    p = states_of(resting).T_M_I[:, 4:]
    assert np.linalg.norm(p - p[0], axis=1).max() < 0.02
    assert {u.mission for u in updates} == {0}


@pytest.mark.parametrize("cameras", [1, 2])
def test_turning_on_the_spot_is_not_rest(cameras: int) -> None:
    """Once the turn is removed, neither tracks nor accelerometer tell a turn from standing still."""
    phases = (
        MotionOptions(kind="stationary", duration_s=1.5),
        MotionOptions(kind="rotation", duration_s=4.0, turns=0.4),
        MotionOptions(kind="stationary", duration_s=1.5),
    )
    device, events, start = events_of(phases=phases, cameras=cameras)
    updates = pushed(Odometry(device, make_starter=start), events)
    begin_ns = updates[0].time_ns
    turning = [u for u in updates if 1.8 <= (u.time_ns - begin_ns) * 1e-9 <= 5.2]
    assert len(turning) > 30
    assert not any(u.motion is Motion.RESTING for u in turning)
    rows = np.searchsorted(start.truth.times_ns, states_of(updates).time_ns)
    turn = so3.multiply(so3.inverse(start.truth.T_R_B[rows, :4]), states_of(updates).T_M_I[:, :4])
    assert np.degrees(np.linalg.norm(so3.log(turn), axis=1)).max() < 1.0


@pytest.mark.parametrize("cameras", [1, 2])
def test_turning_on_the_spot_shows_no_translation(cameras: int) -> None:
    """Landmarks leave the view within two seconds; those that appear have no parallax."""
    phases = (
        MotionOptions(kind="stationary", duration_s=1.5),
        MotionOptions(kind="room_scan", duration_s=4.0, turns=0.2),
        MotionOptions(kind="rotation", duration_s=8.0, turns=0.8),
    )
    device, events, start = events_of(phases=phases, cameras=cameras)
    odometry = Odometry(device, make_starter=start)
    updates = pushed(odometry, events)
    times_s = np.array([u.time_ns - updates[0].time_ns for u in updates]) * 1e-9
    turning = [u for u, t in zip(updates, times_s, strict=True) if 6.0 <= t <= 13.0]
    assert sum(u.motion is Motion.TURNING for u in turning) > 0.9 * len(turning)
    assert min(u.window.num_landmarks for u in turning if u.window is not None) > 20
    released = NavState.stack([u.released for u in updates if u.released is not None])
    states = NavState.stack([released, odometry.window_states()])
    later = states.time_ns >= turning[0].time_ns
    p_M = states.T_M_I[later, 4:]
    true = start.truth.T_R_B[np.searchsorted(start.truth.times_ns, states.time_ns[later]), 4:]
    moved = (p_M - p_M[0]) - (true - true[0])
    distance = np.linalg.norm(moved, axis=1)
    assert np.median(distance[-15:]) < 0.01  # the drift; single images are farther off
    assert distance.max() < 0.05


def with_gap(events: list[Event], from_ns: int, to_ns: int) -> list[Event]:
    """Remove samples of a time."""
    result: list[Event] = []
    for event in events:
        if isinstance(event, ImuBatch):
            kept = (event.times_ns <= from_ns) | (event.times_ns >= to_ns)
            if not kept.any():
                continue
            columns = (event.times_ns, event.accel_gyro, event.is_saturated)
            result.append(ImuBatch(*(column[kept] for column in columns)))
        else:
            result.append(event)
    return result


def test_a_long_gap_of_the_imu_starts_a_new_mission() -> None:
    device, events, start = events_of()
    begin_ns = events[-1].time_ns - 4_000_000_000
    short = with_gap(events, begin_ns, begin_ns + 100_000_000)
    odometry = Odometry(device, make_starter=start)
    assert {u.mission for u in pushed(odometry, short)} == {0}
    long = with_gap(events, begin_ns, begin_ns + 500_000_000)
    odometry = Odometry(device, make_starter=start)
    updates = pushed(odometry, long)
    assert sorted({u.mission for u in updates}) == [0, 1]
    restart, *others = [u for u in updates if "started again" in u.note]
    assert "no IMU samples for 0.50 s" in restart.note
    assert restart.state is None
    assert not others
    assert next(u for u in updates if u.mission == 1).interval is None
    errors = position_errors(start.truth, states_of(updates).time_ns, states_of(updates).T_M_I)
    assert errors.max() < 0.1


@pytest.mark.parametrize(
    ("limits", "reason"),
    [
        ({"max_speed": 1e-3}, "speed"),
        ({"max_velocity_sigma": 1e-6}, "standard deviation of the velocity"),
        ({"max_tilt_sigma_deg": 1e-6}, "standard deviation of the tilt"),
        ({"max_accel_bias": 1e-6}, "bias of the accelerometer"),
        ({"max_gyro_bias": 1e-6}, "bias of the gyroscope"),
    ],
)
def test_every_limit_of_health(limits: dict[str, float], reason: str) -> None:
    device, events, start = events_of()
    health = dataclasses.replace(HealthOptions(), **limits)
    odometry = Odometry(device, OdometryOptions(health=health), make_starter=start)
    updates = pushed(odometry, events[:20])
    assert any(u.note.startswith(f"started again: {reason}") for u in updates)
    assert odometry.starts > 1


def test_wrong_order_is_refused_and_what_was_estimated_stays() -> None:
    device, events, start = events_of()
    odometry = Odometry(device, make_starter=start)
    updates = pushed(odometry, events[:40])
    frame = next(e for e in reversed(events[:40]) if isinstance(e, TrackedFrameSet))
    with pytest.raises(MapError, match=r"does not come after the frame .* in the order"):
        odometry.push_frames(frame)
    batch = next(e for e in reversed(events[:40]) if isinstance(e, ImuBatch))
    with pytest.raises(MapError, match=r"does not come after the sample .* in the order"):
        odometry.push_imu(batch)
    rest = pushed(odometry, events[40:])
    states = states_of([*updates, *rest])
    expected = states_of(pushed(Odometry(device, make_starter=start), events))
    np.testing.assert_array_equal(states.T_M_I, expected.T_M_I)


def test_frames_before_the_first_sample_are_counted() -> None:
    device, events, start = events_of()
    sets = [e for e in events if isinstance(e, TrackedFrameSet)]
    odometry = Odometry(device, make_starter=start)
    late: list[Event] = [e for e in events if e.time_ns > sets[3].time_ns]
    pushed(odometry, [*sets[:3], *late])
    assert odometry.frames_before_imu == 3


def test_frames_without_any_sample() -> None:
    device, events, _ = events_of()
    sets = [e for e in events if isinstance(e, TrackedFrameSet)]
    odometry = Odometry(device)
    step = sets[-1].time_ns - sets[0].time_ns + 100_000_000
    frames = [
        dataclasses.replace(frame, time_ns=frame.time_ns + turn * step)
        for turn in range(9)
        for frame in sets
    ]
    with pytest.raises(MapError, match="after the last IMU sample: check that the IMU"):
        pushed(odometry, [*frames])


def test_a_wrong_mounting_is_estimated_and_given_to_the_sensors() -> None:
    device, events, start = events_of(cameras=1)
    step = np.array([[0.0, 0.0, 0.0, 0.03, -0.02, 0.03]])  # 2.7 deg
    wrong = device.with_cameras(device.cameras, se3.retract(device.T_I_C, step))
    odometry = Odometry(wrong, OdometryOptions(estimate="extrinsics"), make_starter=start)
    states = states_of(pushed(odometry, events))
    odometry.find_calibration()
    estimate = odometry.calibration_estimate
    assert estimate is not None
    assert estimate.differs
    mended = wrong.with_cameras(*estimate.cameras())
    off = np.abs(se3.local(device.T_I_C, mended.T_I_C))
    assert np.degrees(off[:, 3:].max()) < 0.5
    assert position_errors(start.truth, states.time_ns, states.T_M_I)[-1] < 0.1
    assert mended.cameras[0].image_delay_s == 0.0


@pytest.mark.parametrize("known_s", [0.0, 0.004, 0.02])
def test_a_measured_delay_stays_applied_where_cameras_have_known_delays(known_s: float) -> None:
    device, events, start = events_of(cameras=1, is_perfect=True)
    camera = dataclasses.replace(device.cameras[0], image_delay_s=known_s)
    late = device.with_cameras((camera,), device.T_I_C)
    odometry = Odometry(late, make_starter=start)
    odometry._delays = DelayMonitor(late)
    odometry._delays.applied_s = 0.02
    early = [
        dataclasses.replace(event, time_ns=event.time_ns - 20_000_000)
        if isinstance(event, TrackedFrameSet)
        else event
        for event in events
    ]
    updates = pushed(odometry, early[:200])
    states, newest = states_of(updates), updates[-1].window
    assert position_errors(start.truth, states.time_ns, states.T_M_I).max() < 2e-3
    assert newest is not None
    assert newest.median_error_px < 0.01


def test_only_what_is_named_is_estimated() -> None:
    device, events, start = events_of(cameras=1)
    for names, kinds in (("none", ()), ("time_offset", ()), ("line_delay, extrinsics", None)):
        options = OdometryOptions(estimate=names)
        expected = ("line_delay", "extrinsics") if kinds is None else kinds
        assert options.window_states == expected
    odometry = Odometry(device, make_starter=start)
    pushed(odometry, events[:40])
    odometry.find_calibration()
    assert odometry.calibration_estimate is None
    with pytest.raises(FlagError, match="--vio_estimate: there is no focus: give some of"):
        OdometryOptions(estimate="extrinsics,focus")


def test_rows_of_a_known_rolling_shutter_are_no_delay() -> None:
    options = scenario(seed=3, duration_s=10.0, rate_hz=20.0, keypoints=80)
    rolling = [dataclasses.replace(c, line_delay_s=0.02 / c.height_px) for c in options.cameras]
    tracks = simulated(dataclasses.replace(options, cameras=tuple(rolling)))
    unknown = [dataclasses.replace(c, line_delay_ns=0, image_delay_s=0.0) for c in tracks.cameras]
    delays_s = []
    for device in (tracks.device, tracks.device.with_cameras(tuple(unknown), tracks.T_I_C)):
        monitor = DelayMonitor(device)
        for frame in tracks.frames:
            monitor.push(frame)
            monitor.applied_s = 0.0  # frames stay at their times
        delays_s.append(abs(monitor.delay_s))
    assert delays_s[0] < 5e-4
    assert delays_s[1] > 1.5e-3
