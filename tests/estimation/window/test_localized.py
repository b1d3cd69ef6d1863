"""The smoother localised in a map: exactness, consistency, use of information, and re-initialisation."""

import dataclasses

import numpy as np
import pytest

from maplab_py.array_types import F64
from maplab_py.errors import EstimationError
from maplab_py.estimation.kernels.window_arguments import DenseSystem
from maplab_py.estimation.window.alignment import aligned
from maplab_py.estimation.window.localized import LocalizedSmoother
from maplab_py.estimation.window.map_tracks import MapMatches
from maplab_py.estimation.window.options import MapRule, WindowOptions
from maplab_py.estimation.window.smoother import FixedLagSmoother
from maplab_py.geometry import se3, so3
from tests.estimation.window.recordings import SimulatedTracks, scenario, simulated

SIGMA = np.repeat([1e-3, 2e-3, 0.02, 1e-3, 0.02], 3)
PERFECT = np.repeat([1e-5, 1e-5, 1e-4, 1e-5, 1e-4], 3)
T_G_M = se3.make(so3.exp([0.0, 0.0, 0.7]), [3.0, -2.0, 0.5])


@pytest.fixture(scope="module")
def noisy() -> SimulatedTracks:
    return simulated(scenario(duration_s=4.0, keypoints=80))


def smoother_of(tracks: SimulatedTracks, rule: MapRule | None = None) -> LocalizedSmoother:
    return LocalizedSmoother(tracks.cameras, tracks.T_I_C, tracks.imu, WindowOptions(), rule)


def matches_of(tracks: SimulatedTracks, row: int, *, sigma_m: float = 0.0) -> MapMatches:
    """Return the matches of every third track of a frame with the true points in G."""
    ids = np.unique(tracks.frames[row].track_id)[::3]
    _, first = np.unique(tracks.point[ids], return_index=True)
    ids = ids[np.sort(first)]
    point = tracks.point[ids]
    p_G = se3.transform(T_G_M, tracks.p_G[point])
    if not sigma_m:
        return MapMatches(ids, point, p_G)
    error = np.random.default_rng(5).standard_normal(tracks.p_G.shape)[point]
    covariance = np.tile(sigma_m**2 * np.eye(3), (len(ids), 1, 1))
    return MapMatches(ids, point, p_G + sigma_m * error, covariance)


def run(
    smoother: LocalizedSmoother,
    tracks: SimulatedTracks,
    *,
    sigma: F64 = SIGMA,
    every: int = 5,
    start: F64 = T_G_M,
    sigma_m: float = 0.0,
) -> F64:
    """Localise from frame 5 on; return the errors (N, 6) of T_G_I where there is an estimate."""
    smoother.start(tracks.frames[0], tracks.start_state(sigma))
    errors = []
    for row, frame in enumerate(tracks.frames[1:], start=1):
        smoother.add(frame)
        estimate = smoother.map_pose
        if estimate is not None:
            errors.append(se3.local(estimate.T_G_I, se3.compose(T_G_M, tracks.T_M_I[row])))
        if row == 5:
            smoother.start_base_frame(start)
        if row % every == 0:
            assert smoother.associate(matches_of(tracks, row, sigma_m=sigma_m)) > 3
    return np.array(errors)


def test_without_matches_it_is_the_odometry_bit_by_bit(noisy: SimulatedTracks) -> None:
    plain = FixedLagSmoother(noisy.cameras, noisy.T_I_C, noisy.imu, WindowOptions())
    localized = smoother_of(noisy)
    for smoother in (plain, localized):
        smoother.start(noisy.frames[0], noisy.start_state(SIGMA))
    for frame in noisy.frames[1:]:
        expected, update = plain.add(frame), localized.add(frame)
        assert update.state.T_M_I.tobytes() == expected.state.T_M_I.tobytes()
        assert update.covariance.tobytes() == expected.covariance.tobytes()
    assert localized.prior.root.tobytes() == plain.prior.root.tobytes()
    assert localized.map_pose is None


@pytest.mark.parametrize("estimates_landmarks", [False, True], ids=["exact", "estimated"])
def test_replay_without_noise_is_exact(estimates_landmarks: bool) -> None:
    """The start of T_G_M is off; what is left is the error of integrating samples at 800 Hz."""
    tracks = simulated(scenario(duration_s=4.0, noise=False, keypoints=80, imu_rate_hz=800.0))
    off = se3.retract(T_G_M, [0.05, -0.03, 0.02, 0.002, -0.001, 0.02])
    rule = MapRule(estimates_landmarks=estimates_landmarks)
    sigma_m = 1e-6 if estimates_landmarks else 0.0
    errors = run(smoother_of(tracks, rule), tracks, sigma=PERFECT, start=off, sigma_m=sigma_m)
    assert np.abs(errors[10:]).max() < 1e-4


def test_at_constant_velocity_data_without_noise_give_the_pose_to_a_micrometre() -> None:
    """Samples of a uniform motion are integrated exactly, so that nothing is left."""
    tracks = simulated(scenario(duration_s=3.0, noise=False, keypoints=80, kind="straight"))
    off = se3.retract(T_G_M, [0.05, -0.03, 0.02, 0.002, -0.001, 0.02])
    errors = run(smoother_of(tracks), tracks, sigma=PERFECT, start=off)
    assert np.abs(errors[10:]).max() < 1e-6


def test_errors_agree_with_covariances(noisy: SimulatedTracks) -> None:
    smoother = smoother_of(noisy)
    errors = run(smoother, noisy)
    estimate = smoother.map_pose
    assert estimate is not None
    assert len(smoother.map_tracks) > 5
    assert np.linalg.norm(errors[5:, :3], axis=1).max() < 0.03
    assert np.all(np.linalg.eigvalsh(estimate.covariance) > 0.0)
    last = errors[-1]
    assert last @ np.linalg.solve(estimate.covariance, last) < 25.0  # 6 degrees of freedom


def test_offering_a_match_twice_gains_nothing(noisy: SimulatedTracks) -> None:
    covariances = []
    for repeats in (1, 2):
        smoother = smoother_of(noisy)
        smoother.start(noisy.frames[0], noisy.start_state(SIGMA))
        for frame in noisy.frames[1:8]:
            smoother.add(frame)
        smoother.start_base_frame(T_G_M)
        matches = matches_of(noisy, 7)
        assert smoother.associate(matches) == len(matches)
        if repeats == 2:
            assert smoother.associate(matches) == 0
            other = dataclasses.replace(matches, track_id=np.roll(matches.track_id, 1))
            assert smoother.associate(other) == 0
        smoother.add(noisy.frames[8])
        estimate = smoother.map_pose
        assert estimate is not None
        covariances.append(estimate.covariance)
    np.testing.assert_array_equal(covariances[0], covariances[1])


def test_a_track_is_a_landmark_of_the_map_or_of_the_odometry(noisy: SimulatedTracks) -> None:
    smoother = smoother_of(noisy)
    run(smoother, noisy)
    associated = smoother.map_tracks.includes(smoother.tracks.id)
    assert associated.any()
    assert not (associated & smoother.tracks.is_landmark).any()


def test_wrong_matches_are_given_back(noisy: SimulatedTracks) -> None:
    smoother = smoother_of(noisy)
    smoother.start(noisy.frames[0], noisy.start_state(SIGMA))
    for row, frame in enumerate(noisy.frames[1:20], start=1):
        smoother.add(frame)
        if row == 10:
            smoother.start_base_frame(T_G_M)
            matches = matches_of(noisy, row)
            wrong = np.zeros(len(matches), dtype=np.bool_)
            wrong[::4] = True
            p_G = np.where(wrong[:, None], np.roll(matches.p_G, 7, axis=0), matches.p_G)
            smoother.associate(dataclasses.replace(matches, p_G=p_G))
    kept = smoother.map_tracks.matches.track_id
    assert not np.isin(matches.track_id[wrong], kept).any()
    estimate = smoother.map_pose
    assert estimate is not None
    truth = se3.compose(T_G_M, noisy.T_M_I[19])
    assert np.linalg.norm(se3.local(estimate.T_G_I, truth)[:3]) < 0.03


def test_tracks_that_leave_their_landmark_are_given_back_at_once(noisy: SimulatedTracks) -> None:
    """A frame in which they observe something else does not enter the estimate as one of the map."""
    smoother = smoother_of(noisy)
    smoother.start(noisy.frames[0], noisy.start_state(SIGMA))
    for frame in noisy.frames[1:13]:
        smoother.add(frame)
        if frame is noisy.frames[10]:
            smoother.start_base_frame(T_G_M)
            smoother.associate(matches_of(noisy, 10))
    frame = noisy.frames[13]
    before = smoother.map_tracks.matches.track_id
    leaving = np.intersect1d(frame.track_id, before)[::4]
    uv_px = frame.uv_px.copy()
    uv_px[np.isin(frame.track_id, leaving)] += 40.0
    smoother.add(dataclasses.replace(frame, uv_px=uv_px))
    kept = smoother.map_tracks.matches.track_id
    assert len(leaving) > 2
    assert not np.isin(leaving, kept).any()
    estimate = smoother.map_pose
    assert estimate is not None
    assert len(kept) == len(before) - len(leaving)
    truth = se3.compose(T_G_M, noisy.T_M_I[13])
    assert np.linalg.norm(se3.local(estimate.T_G_I, truth)[:3]) < 0.015


def test_uncertain_landmarks_give_wider_covariances(noisy: SimulatedTracks) -> None:
    sigmas = []
    for estimates in (False, True):
        smoother = smoother_of(noisy, MapRule(estimates_landmarks=estimates))
        sigma_m = 0.05 if estimates else 0.0
        run(smoother, noisy, sigma_m=sigma_m)
        estimate = smoother.map_pose
        assert estimate is not None
        sigmas.append(float(np.sqrt(np.trace(estimate.covariance[:3, :3]))))
    assert sigmas[1] > 1.5 * sigmas[0]


def test_a_new_base_frame_forgets_the_old_one(noisy: SimulatedTracks) -> None:
    smoother = smoother_of(noisy)
    run(smoother, noisy)
    before = smoother.states.T_M_I.copy()
    moved = se3.compose(se3.make(so3.exp([0.0, 0.0, 0.3]), [5.0, 1.0, 0.0]), T_G_M)
    smoother.start_base_frame(moved)
    assert not len(smoother.map_tracks)
    np.testing.assert_array_equal(smoother.states.T_M_I, before)
    np.testing.assert_array_equal(smoother.states.T_G_M[0], moved)
    assert not smoother.prior.is_base_fixed
    weak = smoother.prior.information[-6:]
    assert np.abs(weak[:, :-6]).max() == 0.0
    smoother.stop_base_frame()
    assert smoother.map_pose is None
    assert smoother.prior.root.shape[1] == 15 * len(smoother.states)


def test_alignment_is_the_window_with_all_but_the_base_frame_fixed(noisy: SimulatedTracks) -> None:
    """Frames with a tight prior do not move: what is left is the alignment over the same matches."""
    smoother = smoother_of(noisy)
    smoother.start(noisy.frames[0], noisy.start_state(SIGMA))
    for frame in noisy.frames[1:12]:
        smoother.add(frame)
    smoother.start_base_frame(se3.retract(T_G_M, [0.02, -0.02, 0.01, 0.001, 0.001, 0.01]))
    smoother.associate(matches_of(noisy, 11))
    _, states = smoother.problem()
    terms, rule = smoother.map_terms, smoother.rule
    assert terms is not None
    sigma = np.repeat([rule.base_sigma_m, rule.base_sigma_rad], 3)
    result, covariance = aligned(terms, states, sigma, function_tolerance=0.0, num_iterations=30)
    now = states
    for _ in range(12):  # Gauss-Newton over all states, of which only the last six may move
        system = DenseSystem.zeros(15 * len(now) + 6)
        terms.add_to(system, now, now)
        prior = se3.local(states.T_G_M[0], now.T_G_M[0]) / sigma**2
        lower = np.tril(system.matrix[-6:, -6:])
        fixed = lower + np.tril(lower, -1).T + np.diag(1.0 / sigma**2)
        step = np.zeros(15 * len(now) + 6)
        step[-6:] = -np.linalg.solve(fixed, system.gradient[-6:] + prior)
        now = now.moved(step, now.h)
    np.testing.assert_allclose(se3.local(result, now.T_G_M[0]), 0.0, atol=1e-5)
    assert np.linalg.eigvalsh(covariance).min() > 0.0


def test_there_is_nothing_to_associate_before_a_base_frame(noisy: SimulatedTracks) -> None:
    smoother = smoother_of(noisy)
    with pytest.raises(EstimationError, match="start_base_frame"):
        smoother.associate(matches_of(noisy, 1))
    with pytest.raises(EstimationError, match="call start"):
        smoother.start_base_frame(T_G_M)


@pytest.mark.parametrize("estimates_landmarks", [False, True], ids=["exact", "estimated"])
def test_a_step_costs_what_the_next_linearisation_says(
    noisy: SimulatedTracks, estimates_landmarks: bool
) -> None:
    """The costs of a step include those of the map, and without a loss the promise is kept."""
    smoother = LocalizedSmoother(
        noisy.cameras, noisy.T_I_C, noisy.imu, WindowOptions(huber_sigmas=1e3),
        MapRule(estimates_landmarks=estimates_landmarks),
    )  # fmt: skip
    smoother.start(noisy.frames[0], noisy.start_state(SIGMA))
    for frame in noisy.frames[1:12]:
        smoother.add(frame)
    smoother.start_base_frame(se3.retract(T_G_M, [0.01, -0.01, 0.01, 0.001, 0.001, 0.005]))
    smoother.associate(matches_of(noisy, 11, sigma_m=0.02 if estimates_landmarks else 0.0))
    problem, states = smoother.problem()
    linear = problem.linearize(states, 1e-6)
    step = problem.try_step(states, linear, 1e-6)
    after = problem.linearize(step.states, 1e-6).costs
    assert set(step.costs) == set(after)
    assert "map" in after
    assert step.cost == pytest.approx(sum(after.values()), rel=1e-9)
    decrease = sum(linear.costs.values()) - step.cost
    assert decrease == pytest.approx(step.promised, rel=0.05)
