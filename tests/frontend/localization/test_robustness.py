"""False matches, an outage, rest and turning on the spot."""

import dataclasses

import numpy as np
import pytest

from maplab_py.array_types import F64, U8, Mask
from maplab_py.estimation.window.frame import Motion
from maplab_py.frontend.localization.map_source import SearchedMap, of_map
from maplab_py.frontend.localization.online import LocalizedFrame
from maplab_py.frontend.localization.options import OnlineLocalizationOptions
from maplab_py.geometry import se3
from maplab_py.simulation.scenario import MotionOptions, SessionOptions
from tests.frontend.localization.places import Place, place_of, run

OPTIONS = OnlineLocalizationOptions()
WALK = SessionOptions(duration_s=44.0, turns=2.0, start_turn=0.2, height_m=1.7)
LONG_WALK, OUTAGE_S = dataclasses.replace(WALK, duration_s=100.0, turns=4.3), (8.0, 94.0)
RESTS = (
    MotionOptions(kind="room_scan", duration_s=8.0, turns=0.4, start_turn=0.2),
    MotionOptions(kind="stationary", duration_s=40.0),
)
STOPS = (
    RESTS[0],
    MotionOptions(kind="stationary", duration_s=6.0),
    MotionOptions(kind="room_scan", duration_s=5.0, turns=0.2),
    MotionOptions(kind="stationary", duration_s=6.0),
    MotionOptions(kind="room_scan", duration_s=5.0, turns=0.2),
)
SLOW_MPS = 0.2
SLOWLY = (RESTS[0], MotionOptions(kind="straight", duration_s=9.0, speed_mps=SLOW_MPS))
TURNS = (RESTS[0], MotionOptions(kind="rotation", duration_s=10.0, turns=1.0))


def searched(where: Place) -> SearchedMap:
    return of_map(where.vi_map, "map")


def with_false_descriptors(where: Place, is_false: Mask, seed: int = 5) -> Place:
    """Return the place with the descriptors of some keypoints (K,) of the query exchanged."""
    descriptor = where.query.keypoints.descriptor.copy()
    rows = np.flatnonzero(is_false)
    descriptor[rows] = descriptor[np.random.default_rng(seed).permutation(rows)]
    return with_descriptors(where, descriptor)


def with_random_descriptors(where: Place, is_random: Mask, seed: int = 5) -> Place:
    """Return the place with random descriptors of some keypoints (K,) of the query: none matches."""
    descriptor = where.query.keypoints.descriptor.copy()
    shape = np.count_nonzero(is_random), descriptor.shape[1]
    descriptor[is_random] = np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)
    return with_descriptors(where, descriptor)


def with_descriptors(where: Place, descriptor: U8) -> Place:
    query = where.query.replace(keypoints=where.query.keypoints.replace(descriptor=descriptor))
    return dataclasses.replace(where, query=query)


def seconds(where: Place, frames: list[LocalizedFrame]) -> F64:
    return (np.array([frame.time_ns for frame in frames]) - where.times_ns[0]) * 1e-9


def differences(where: Place, frames: list[LocalizedFrame]) -> F64:
    """Return [dp, dtheta] (N, 6) of all frames against the truth, nan where there is no pose."""
    rows = np.searchsorted(where.times_ns, [frame.time_ns for frame in frames])
    result = np.full((len(frames), 6), np.nan)
    for k, frame in enumerate(frames):
        if frame.pose is not None:
            result[k] = se3.local(where.T_G_I[rows[k]], frame.pose.T_G_I)
    return result


@pytest.mark.slow
def test_false_matches_give_no_wrong_pose() -> None:
    where = place_of(WALK)
    rng = np.random.default_rng(1)
    is_false = rng.random(len(where.query.keypoints)) < 0.3
    localization, frames, _ = run(OPTIONS, searched(where), with_false_descriptors(where, is_false))
    delta = differences(where, frames)
    known = np.isfinite(delta[:, 0])
    assert known.mean() > 0.9
    assert np.linalg.norm(delta[known, :3], axis=1).max() < 0.5
    assert np.degrees(np.linalg.norm(delta[known, 3:], axis=1).max()) < 5.0
    assert localization.counts.starts == 1


@pytest.mark.slow
def test_after_an_outage_the_pose_comes_back_without_a_jump_of_the_odometry() -> None:
    where, outage_s = place_of(LONG_WALK), OUTAGE_S
    query = where.query
    time_s = (query.vertices.timestamp_ns[query.keypoint_vertex] - where.times_ns[0]) * 1e-9
    is_out = (time_s >= outage_s[0]) & (time_s < outage_s[1])
    localization, frames, updates = run(
        OPTIONS, searched(where), with_random_descriptors(where, is_out)
    )
    at_s = seconds(where, frames)
    answered = np.array([frame.answer is not None for frame in frames])
    assert not answered[(at_s > outage_s[0]) & (at_s < outage_s[1])].any()
    first_s = float(at_s[answered & (at_s >= outage_s[1])].min())
    assert first_s - outage_s[1] < 1.0
    error = np.linalg.norm(differences(where, frames)[:, :3], axis=1)
    assert np.nanmax(error[at_s > first_s + 1.0]) < 0.05
    truth = where.start.truth
    T_M_I = np.concatenate([u.state.T_M_I for u in updates if u.state is not None])
    step = np.linalg.norm(np.diff(T_M_I[:, 4:] - truth.T_R_B[:, 4:], axis=0), axis=1)
    sigma = np.array(
        [
            np.inf if u.window is None else np.sqrt(np.trace(u.window.covariance[:3, :3]))
            for u in updates[1:]
        ]
    )
    before = np.concatenate([[np.inf], sigma[:-1]])
    assert np.all(step < 3.0 * before)
    assert localization.counts.late == 0


@pytest.mark.slow
@pytest.mark.parametrize("phases", [RESTS, TURNS], ids=["at rest", "turning on the spot"])
def test_the_pose_stays_where_it_is(phases: tuple[MotionOptions, ...]) -> None:
    """At rest a tracker repeats itself: independent noise of 0.8 px would look like motion."""
    where = place_of(SessionOptions(phases=phases, duration_s=0.0), keypoint_sigma_px=0.15)
    _, frames, _ = run(OPTIONS, searched(where), where)
    at_s = seconds(where, frames)
    error = differences(where, frames)[:, :3]
    before = error[(at_s > 6.0) & (at_s <= phases[0].duration_s)][-1]
    later = error[at_s > phases[0].duration_s + 1.0]
    assert np.isfinite(later).all()
    assert np.linalg.norm(later - before, axis=1).max() < 0.03


@pytest.mark.slow
def test_the_pose_stays_where_it_is_at_every_stop() -> None:
    where = place_of(SessionOptions(phases=STOPS, duration_s=0.0), keypoint_sigma_px=0.15)
    _, frames, _ = run(OPTIONS, searched(where), where)
    at_s, error = seconds(where, frames), differences(where, frames)[:, :3]
    end_s = np.cumsum([phase.duration_s for phase in STOPS])
    for row in (1, 3):  # the stops
        before = error[at_s <= end_s[row - 1]][-1]
        during = error[(at_s > end_s[row - 1] + 1.0) & (at_s <= end_s[row])]
        assert len(during) > 10
        assert np.linalg.norm(during - before, axis=1).max() < 0.03
    assert np.nanmax(np.linalg.norm(error[at_s > 3.0], axis=1)) < 0.05


@pytest.mark.slow
def test_a_slow_constant_velocity_is_not_taken_for_rest() -> None:
    where = place_of(SessionOptions(phases=SLOWLY, duration_s=0.0), keypoint_sigma_px=0.15)
    _, frames, updates = run(OPTIONS, searched(where), where)
    at_s, error = seconds(where, frames), differences(where, frames)[:, :3]
    begin_s, end_s = RESTS[0].duration_s, sum(phase.duration_s for phase in SLOWLY)
    straight = (at_s > begin_s + 1.5) & (at_s < end_s - 1.5)  # phases are joined smoothly
    truth, v_M = where.start.truth, []
    assert truth.v_R is not None
    for update in (u for u, is_straight in zip(updates, straight, strict=True) if is_straight):
        assert update.motion is Motion.MOVING
        assert update.state is not None
        v_M.append(update.state.v_M[0])
    expected = truth.v_R[np.searchsorted(truth.times_ns, [f.time_ns for f in frames])][straight]
    np.testing.assert_allclose(np.linalg.norm(expected, axis=1), SLOW_MPS, atol=0.03)
    np.testing.assert_allclose(np.array(v_M), expected, atol=0.03)
    assert np.linalg.norm(error[straight], axis=1).max() < 0.05
