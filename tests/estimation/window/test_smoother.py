"""The smoother end to end on simulated tracks."""

import dataclasses
import os
import subprocess

import numpy as np
import pytest

from maplab_py.array_types import F64
from maplab_py.errors import EstimationError, MapError, UserError
from maplab_py.estimation.window.frame import Motion, WindowFrame, WindowUpdate
from maplab_py.estimation.window.options import WindowOptions
from maplab_py.estimation.window.smoother import FixedLagSmoother
from maplab_py.geometry import se3
from tests.estimation.window.digest import digest_of_run
from tests.estimation.window.recordings import SimulatedTracks, scenario, simulated
from tests.support.programs import module_of_tests

PERFECT = np.repeat([1e-5, 1e-5, 1e-4, 1e-5, 1e-4], 3)
SIGMA = np.repeat([1e-3, 2e-3, 0.02, 1e-3, 0.02], 3)


@pytest.fixture(scope="module")
def noisy() -> SimulatedTracks:
    return simulated(scenario(duration_s=4.0, keypoints=80))


def run(
    tracks: SimulatedTracks, options: WindowOptions | None = None, *, sigma: F64 = SIGMA
) -> tuple[FixedLagSmoother, list[WindowUpdate]]:
    smoother = FixedLagSmoother(
        tracks.cameras, tracks.T_I_C, tracks.imu, options or WindowOptions()
    )
    smoother.start(tracks.frames[0], tracks.start_state(sigma))
    return smoother, [smoother.add(frame) for frame in tracks.frames[1:]]


@pytest.mark.parametrize("stereo", [True, False], ids=["stereo", "mono"])
def test_replay_without_noise_is_exact(stereo: bool) -> None:
    """What is left is the error of integrating samples at 800 Hz."""
    tracks = simulated(
        scenario(duration_s=6.0, stereo=stereo, noise=False, keypoints=80, imu_rate_hz=800.0)
    )
    _, updates = run(tracks, sigma=PERFECT)
    estimates = np.array([update.state.T_M_I[0] for update in updates])
    error = se3.local(estimates, tracks.T_M_I[1:])
    assert np.linalg.norm(error[:, :3], axis=1).max() < 1e-4
    assert np.linalg.norm(error[:, 3:], axis=1).max() < 1e-4
    released = {
        int(t): T
        for u in updates
        for t, T in zip(u.released.time_ns, u.released.T_M_I, strict=True)
    }
    rows = [k for k, frame in enumerate(tracks.frames) if frame.time_ns in released]
    final = np.array([released[tracks.frames[k].time_ns] for k in rows])
    assert np.abs(se3.local(final, tracks.T_M_I[rows])[:, :3]).max() < 1e-4
    assert len(rows) > 40


def test_errors_agree_with_covariances(noisy: SimulatedTracks) -> None:
    _, updates = run(noisy)
    nees = []
    for update, truth in zip(updates[10:], noisy.T_M_I[11:], strict=True):
        error, covariance = se3.local(update.state.T_M_I[0], truth), update.covariance[:6, :6]
        assert np.all(np.linalg.eigvalsh(update.covariance) > 0.0)
        nees.append(error @ np.linalg.solve(covariance, error))
    assert 1.0 < np.mean(nees) < 12.0  # 6 degrees of freedom, a single session


def test_window_stays_within_its_size(noisy: SimulatedTracks) -> None:
    options = WindowOptions(num_keyframes=4, num_recent_frames=2)
    smoother = FixedLagSmoother(noisy.cameras, noisy.T_I_C, noisy.imu, options)
    smoother.start(noisy.frames[0], noisy.start_state(SIGMA))
    times = [noisy.frames[0].time_ns]
    for frame in noisy.frames[1:]:
        update = smoother.add(frame)
        times.append(frame.time_ns)
        for time_ns in update.released.time_ns.tolist():
            times.remove(time_ns)
        assert smoother.times_ns.tolist() == times
        assert len(times) <= 6
        assert smoother.tracks.num_active_landmarks <= options.max_landmarks
        assert np.all(smoother.tracks.observations.frame < len(times))


def test_ended_tracks_leave_room_for_those_that_go_on(noisy: SimulatedTracks) -> None:
    """Their landmarks stay in the window, but the newest frame has as many as it may see."""
    options = WindowOptions(num_keyframes=12, max_landmarks=20)
    smoother = FixedLagSmoother(noisy.cameras, noisy.T_I_C, noisy.imu, options)
    smoother.start(noisy.frames[0], noisy.start_state(SIGMA))
    active, ended = [], []
    for frame in noisy.frames[1:]:
        update = smoother.add(frame)
        active.append(smoother.tracks.num_active_landmarks)
        ended.append(update.num_landmarks - active[-1])
    assert min(active[5:]) > 10
    assert max(active) == 20
    assert max(ended) > 20


def test_landmarks_are_anchored_where_they_were_first_seen(noisy: SimulatedTracks) -> None:
    smoother, _ = run(noisy)
    tracks = smoother.tracks
    rows = tracks.landmark_rows
    data, _ = tracks.data(rows, 1.345)
    np.testing.assert_array_equal(data.anchor_frame, data.frame[data.start[:-1]])
    np.testing.assert_array_equal(data.anchor_camera, data.camera[data.start[:-1]])
    ids, p_M = smoother.landmarks()
    assert len(ids) == len(p_M) == len(rows) > 20
    assert np.all(np.diff(ids) > 0)
    size = np.array([8.0, 6.5, 3.0])
    assert np.mean(np.all(np.abs(p_M - [0, 0, 1.5]) < 0.6 * size, axis=1)) > 0.95


def test_outliers_do_not_matter(noisy: SimulatedTracks) -> None:
    rng = np.random.default_rng(9)
    frames = []
    for frame in noisy.frames:
        uv = frame.uv_px.copy()
        bad = rng.random(len(uv)) < 0.05
        uv[bad] += rng.uniform(-60.0, 60.0, (np.count_nonzero(bad), 2))
        frames.append(dataclasses.replace(frame, uv_px=uv))
    _, clean = run(noisy)
    _, updates = run(dataclasses.replace(noisy, frames=frames))
    error = se3.local(updates[-1].state.T_M_I[0], noisy.T_M_I[-1])
    clean_error = se3.local(clean[-1].state.T_M_I[0], noisy.T_M_I[-1])
    assert np.linalg.norm(error[:3]) < 0.03
    assert np.linalg.norm(error[:3] - clean_error[:3]) < 0.02


def still_frames(tracks: SimulatedTracks, seconds: float) -> SimulatedTracks:
    """Return a body that stands still at the first frame: its tracks, and gravity with noise."""
    rng = np.random.default_rng(10)
    first = tracks.frames[0]
    step_ns, count = 5_000_000, 20
    force_I = se3.to_matrix(tracks.T_M_I[0])[:3, :3].T @ [0.0, 0.0, 9.81]
    sample = np.concatenate([force_I + tracks.accel_bias[0], tracks.gyro_bias[0]])
    noise = np.repeat([2e-3, 1.7e-4], 3) * np.sqrt(200.0)
    frames = [first]
    values = sample + noise * rng.standard_normal((1, 6))
    for number in range(round(10 * seconds)):
        start_ns = first.time_ns + number * step_ns * count
        fresh = sample + noise * rng.standard_normal((count, 6))
        values = np.concatenate([values[-1:], fresh])
        uv = first.uv_px + rng.normal(0.0, 0.3, first.uv_px.shape)
        times_ns = start_ns + step_ns * np.arange(count + 1)
        frames.append(
            dataclasses.replace(
                first, time_ns=int(times_ns[-1]), imu_times_ns=times_ns, accel_gyro=values,
                uv_px=uv, motion=Motion.RESTING,
            )
        )  # fmt: skip
    rows = np.zeros(len(frames), dtype=np.int64)
    names = ("T_M_I", "v_M", "gyro_bias", "accel_bias")
    return dataclasses.replace(
        tracks, frames=frames, **{name: getattr(tracks, name)[rows] for name in names}
    )


def test_standing_still_neither_drifts_nor_adds_keyframes(noisy: SimulatedTracks) -> None:
    tracks = still_frames(noisy, 30.0)
    smoother = FixedLagSmoother(tracks.cameras, tracks.T_I_C, tracks.imu, WindowOptions())
    sigma = SIGMA.copy()
    sigma[6:9] = 0.1
    smoother.start(tracks.frames[0], tracks.start_state(sigma, np.random.default_rng(11)))
    start = smoother.states.T_M_I[0].copy()
    updates = [smoother.add(frame) for frame in tracks.frames[1:]]
    assert not any(update.is_keyframe for update in updates)
    assert np.linalg.norm(updates[-1].state.T_M_I[0, 4:] - start[4:]) < 0.02
    assert np.linalg.norm(updates[-1].state.v_M) < 0.01
    assert np.linalg.norm(updates[-1].state.gyro_bias - tracks.gyro_bias[0]) < 2e-4
    assert len(smoother.times_ns) <= 3
    assert max(len(update.released) for update in updates) <= 2


def test_results_do_not_depend_on_the_number_of_threads() -> None:
    digests = set()
    for count in ("1", "2"):
        threads = {"NUMBA_NUM_THREADS": count, "OPENBLAS_NUM_THREADS": count}
        finished = subprocess.run(
            module_of_tests("tests.estimation.window.digest"),
            env={**os.environ, **threads}, check=True, capture_output=True, text=True,
        )  # fmt: skip
        digests.add(finished.stdout.strip())
    assert digests == {digest_of_run()}


def test_refuses_to_start_twice_or_not_at_all(noisy: SimulatedTracks) -> None:
    smoother = FixedLagSmoother(noisy.cameras, noisy.T_I_C, noisy.imu, WindowOptions())
    with pytest.raises(EstimationError, match="call start"):
        smoother.add(noisy.frames[1])
    smoother.start(noisy.frames[0], noisy.start_state(SIGMA))
    with pytest.raises(EstimationError, match="already"):
        smoother.start(noisy.frames[0], noisy.start_state(SIGMA))


def test_refuses_bad_frames(noisy: SimulatedTracks) -> None:
    smoother = FixedLagSmoother(noisy.cameras, noisy.T_I_C, noisy.imu, WindowOptions())
    smoother.start(noisy.frames[0], noisy.start_state(SIGMA))
    frame = noisy.frames[1]
    with pytest.raises(UserError, match="differ in length"):
        dataclasses.replace(frame, sigma_px=frame.sigma_px[1:])
    backwards = dataclasses.replace(frame, imu_times_ns=frame.imu_times_ns[::-1].copy())
    with pytest.raises(MapError, match="before"):
        smoother.add(backwards)


def without_keypoints(frame: WindowFrame) -> WindowFrame:
    return dataclasses.replace(
        frame, camera=frame.camera[:0], track_id=frame.track_id[:0],
        uv_px=frame.uv_px[:0], sigma_px=frame.sigma_px[:0],
    )  # fmt: skip


def test_goes_on_without_keypoints_and_recovers(noisy: SimulatedTracks) -> None:
    frames = [
        without_keypoints(frame) if 12 <= row < 22 else frame
        for row, frame in enumerate(noisy.frames)
    ]
    _, updates = run(dataclasses.replace(noisy, frames=frames))
    uncertain = [np.sqrt(np.trace(update.covariance[:3, :3])) for update in updates]
    assert uncertain[20] > 2.0 * uncertain[10]
    error = se3.local(updates[-1].state.T_M_I[0], noisy.T_M_I[-1])
    assert np.linalg.norm(error[:3]) < 4.0 * uncertain[-1]


def test_starts_without_keypoints(noisy: SimulatedTracks) -> None:
    frames = [without_keypoints(frame) for frame in noisy.frames[:12]]
    smoother, updates = run(dataclasses.replace(noisy, frames=frames))
    assert updates[-1].num_landmarks == 0
    assert np.isnan(updates[-1].median_error_px)
    assert np.all(np.isfinite(updates[-1].covariance))
    assert len(smoother.landmarks()[0]) == 0


def turning(tracks: SimulatedTracks) -> SimulatedTracks:
    frames = [dataclasses.replace(frame, motion=Motion.TURNING) for frame in tracks.frames]
    return dataclasses.replace(tracks, frames=frames)


def test_no_landmarks_from_motion_while_turning_without_parallax(noisy: SimulatedTracks) -> None:
    left = [
        dataclasses.replace(
            frame, camera=frame.camera[mask], track_id=frame.track_id[mask],
            uv_px=frame.uv_px[mask], sigma_px=frame.sigma_px[mask],
        )
        for frame in noisy.frames[:15]
        for mask in [frame.camera == 0]
    ]  # fmt: skip
    mono = dataclasses.replace(noisy, frames=left, cameras=noisy.cameras[:1], T_I_C=noisy.T_I_C[:1])
    assert run(mono)[1][-1].num_landmarks > 10
    updates = run(turning(mono))[1]
    since_ns = [update.state.time_ns[0] - mono.frames[0].time_ns for update in updates]
    early = [u.num_landmarks for u, ns in zip(updates, since_ns, strict=True) if ns < 350_000_000]
    assert len(early) >= 2
    assert not any(early)
    assert updates[-1].num_landmarks > 10  # the frames move: parallax over half a second shows it
    assert run(turning(noisy))[1][5].num_landmarks > 10  # by stereo


def test_turning_has_no_velocity_unless_the_estimate_contradicts(noisy: SimulatedTracks) -> None:
    first = dataclasses.replace(noisy, frames=noisy.frames[:2])
    tight = WindowOptions(turning_max_mps=100.0, turning_sigma_mps=1e-4)
    assert np.linalg.norm(noisy.v_M[1]) > 0.2
    _, updates = run(turning(first), tight)
    assert np.linalg.norm(updates[0].state.v_M) < 0.05
    _, updates = run(turning(first), dataclasses.replace(tight, turning_max_mps=0.1))
    assert np.linalg.norm(updates[0].state.v_M - noisy.v_M[1]) < 0.05


def test_thesis_policy_keeps_few_landmarks(noisy: SimulatedTracks) -> None:
    options = WindowOptions(landmark_policy="thesis", thesis_persistent_landmarks=5)
    smoother, updates = run(noisy, options)
    assert smoother.tracks.is_landmark.sum() <= 5
    assert max(update.num_landmarks for update in updates) <= 5 + 50
    assert len(smoother.states) <= 5 + 3
    error = se3.local(updates[-1].state.T_M_I[0], noisy.T_M_I[-1])
    assert np.linalg.norm(error[:3]) < 0.03


def test_errors_far_beyond_the_others_of_sharp_images_are_outliers() -> None:
    options, sigma = WindowOptions(gate_chi2=9.0), np.array([0.5, 1.0])
    np.testing.assert_allclose(options.largest_error_px(sigma, 0.01), [0.25, 0.5])
    np.testing.assert_allclose(options.largest_error_px(sigma, 0.1), [0.8, 0.8])
    np.testing.assert_allclose(options.largest_error_px(sigma, 0.25), [1.5, 2.0])
