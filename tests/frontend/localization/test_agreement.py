"""When T_G_M is set and set again, and what happens to late answers."""

import dataclasses
import itertools

import numpy as np
import pytest

from maplab_py.array_types import F64
from maplab_py.frontend.localization.agreement import AgreementFilter, Verdict
from maplab_py.frontend.localization.map_source import of_summary
from maplab_py.frontend.localization.matcher import Answer
from maplab_py.frontend.localization.online import OnlineLocalization
from maplab_py.frontend.localization.options import OnlineLocalizationOptions
from maplab_py.frontend.odometry import Odometry
from maplab_py.geometry import se3
from maplab_py.interop.recordings.stream import EventStream
from tests.frontend.known_start import updates_of
from tests.frontend.localization.places import place, searched, summary

P_G = np.array([[5.0, 0.0, 0.0], [5.0, 1.0, 0.0], [5.0, 0.0, 1.0], [6.0, -1.0, 1.0]])
NEAR = se3.make([0.0, 0.0, 0.0, 1.0], [0.0, 0.4, 0.0])
AWAY = se3.make([0.0, 0.0, 0.0, 1.0], [3.0, 0.0, 0.0])
HERE = se3.identity()


def answer(time_ns: int, T_G_I: F64) -> Answer:
    """Return an answer whose rays are exact at a pose."""
    p_I = se3.transform(se3.inverse(T_G_I), P_G)
    ray = p_I / np.linalg.norm(p_I, axis=1, keepdims=True)
    rows = np.arange(len(P_G))
    return Answer(
        time_ns, rows, np.zeros(len(P_G), dtype=np.int32), rows,
        np.zeros((len(P_G), 3)), ray, np.full(len(P_G), 1e-3), T_G_I, 1e-4 * np.eye(6),
    )  # fmt: skip


def repeated(once: Answer, times: int) -> Answer:
    """Return an answer whose matches occur several times."""
    names = ("track_id", "camera", "landmark", "origin_I", "ray_I", "rad_per_px")
    columns = {name: np.concatenate([getattr(once, name)] * times) for name in names}
    return dataclasses.replace(once, **columns)


def test_two_answers_that_agree_start() -> None:
    rule = AgreementFilter(2, 20.0)
    assert rule.judge(answer(0, HERE), HERE, None, P_G, path_m=0.0) is Verdict.WAIT
    assert rule.judge(answer(10**9, HERE), HERE, None, P_G, path_m=0.0) is Verdict.START
    assert [a.time_ns for a in rule.take()] == [0, 10**9]
    assert rule.take() == []


def test_answers_that_contradict_each_other_do_not() -> None:
    rule = AgreementFilter(2, 20.0)
    for time_ns, T_G_I in enumerate([HERE, AWAY, HERE, AWAY]):
        assert rule.judge(answer(time_ns, T_G_I), HERE, None, P_G, path_m=0.0) is Verdict.WAIT
    late = answer(60 * 10**9, AWAY)
    assert (
        rule.judge(late, HERE, None, P_G, path_m=0.0) is Verdict.WAIT
    )  # agrees, but with something old


def test_a_single_contradiction_never_resets() -> None:
    rule = AgreementFilter(2, 20.0)
    assert rule.judge(answer(0, HERE), HERE, HERE, P_G, path_m=0.0) is Verdict.USE
    assert rule.judge(answer(1, NEAR), HERE, HERE, P_G, path_m=0.0) is Verdict.WAIT
    assert rule.judge(answer(2, HERE), HERE, HERE, P_G, path_m=0.0) is Verdict.USE
    assert rule.judge(answer(3, NEAR), HERE, HERE, P_G, path_m=0.0) is Verdict.WAIT
    assert rule.judge(answer(4, NEAR), HERE, HERE, P_G, path_m=0.0) is Verdict.START


def test_more_than_the_drift_is_believed_after_four_times_as_many_answers() -> None:
    """A place that looks alike gives answers that agree with each other for a while."""
    rule = AgreementFilter(2, 20.0)
    assert rule.judge(answer(0, HERE), HERE, HERE, P_G, path_m=10.0) is Verdict.USE
    for time_ns in range(1, 8):
        assert rule.judge(answer(time_ns, AWAY), HERE, HERE, P_G, path_m=10.0) is Verdict.WAIT
    assert rule.judge(answer(8, AWAY), HERE, HERE, P_G, path_m=10.0) is Verdict.START
    assert len(rule.take()) == 8


def test_answers_with_many_matches_need_not_agree_for_longer() -> None:
    """In a map that was moved each answer has dozens of matches, and none supports the estimate."""
    rule = AgreementFilter(2, 20.0)
    assert rule.judge(answer(0, HERE), HERE, HERE, P_G, path_m=10.0) is Verdict.USE
    for repeats, expected in ((10, Verdict.START), (9, Verdict.WAIT)):
        rule.clear()
        many = [repeated(answer(time_ns, AWAY), repeats) for time_ns in (1, 2)]
        assert rule.judge(many[0], HERE, HERE, P_G, path_m=10.0) is Verdict.WAIT
        assert rule.judge(many[1], HERE, HERE, P_G, path_m=10.0) is expected
    rule.clear()
    many = [repeated(answer(time_ns, AWAY), 10) for time_ns in (1, 3)]
    assert rule.judge(many[0], HERE, HERE, P_G, path_m=10.0) is Verdict.WAIT
    assert rule.judge(answer(2, HERE), HERE, HERE, P_G, path_m=10.0) is Verdict.USE
    assert rule.judge(many[1], HERE, HERE, P_G, path_m=10.0) is Verdict.WAIT


def test_the_longer_the_path_the_more_drift_is_believed() -> None:
    rule = AgreementFilter(2, 20.0)
    assert rule.judge(answer(0, HERE), HERE, HERE, P_G, path_m=10.0) is Verdict.USE
    assert rule.judge(answer(1, AWAY), HERE, HERE, P_G, path_m=61.0) is Verdict.WAIT
    assert rule.judge(answer(2, AWAY), HERE, HERE, P_G, path_m=61.0) is Verdict.START
    rule.clear()
    assert rule.judge(answer(3, AWAY), HERE, HERE, P_G, path_m=61.0) is Verdict.WAIT
    assert rule.judge(answer(4, AWAY), HERE, HERE, P_G, path_m=61.0) is Verdict.START


def test_matches_without_a_pose_are_used_but_start_nothing() -> None:
    rule = AgreementFilter(1, 20.0)
    few = dataclasses.replace(answer(0, HERE), T_G_I=None, covariance=None)
    assert rule.judge(few, HERE, None, P_G, path_m=0.0) is Verdict.WAIT
    assert rule.judge(few, HERE, HERE, P_G, path_m=0.0) is Verdict.USE
    assert rule.judge(few, HERE, AWAY, P_G, path_m=0.0) is Verdict.WAIT


@pytest.fixture(scope="module")
def halfway() -> tuple[OnlineLocalization, Odometry, list[Answer]]:
    """Return a localisation in the middle of a run, and the answers it has got so far."""
    where, options = place(), OnlineLocalizationOptions()
    recording = where.recording()
    odometry = Odometry(recording.device, make_starter=where.start, map_rule=options.rule)
    localization = OnlineLocalization(searched(), recording.device, options)
    some = itertools.islice(updates_of(odometry, EventStream(recording)), 20)
    frames = [localization.after_frame(update, odometry.smoother) for update in some]
    return localization, odometry, [f.answer for f in frames if f.answer is not None]


def test_a_late_answer_joins_its_frame(
    halfway: tuple[OnlineLocalization, Odometry, list[Answer]],
) -> None:
    localization, odometry, answers = halfway
    assert odometry.smoother is not None
    before = localization.counts.late
    assert localization.take(answers[-1], odometry.smoother)
    assert localization.counts.late == before


def test_a_lost_answer_is_dropped_and_counted(
    halfway: tuple[OnlineLocalization, Odometry, list[Answer]],
) -> None:
    localization, odometry, answers = halfway
    assert odometry.smoother is not None
    before = localization.counts.late
    unknown = dataclasses.replace(answers[-1], time_ns=answers[-1].time_ns + 1)
    assert not localization.take(unknown, odometry.smoother)
    ended = dataclasses.replace(answers[-1], track_id=answers[-1].track_id + 10**9)
    assert not localization.take(ended, odometry.smoother)
    assert localization.counts.late == before + 2


def test_a_map_that_moved_is_found_again_within_a_second_and_a_half() -> None:
    """The map moves by 2 m while the query runs: answers beyond any drift, but with many matches."""
    where, options = place(), OnlineLocalizationOptions()
    map_ = of_summary(dataclasses.replace(summary(), p_G=summary().p_G.copy()), "summary")
    recording, shift = where.recording(), np.array([2.0, 0.5, 0.0])
    odometry = Odometry(recording.device, make_starter=where.start, map_rule=options.rule)
    localization = OnlineLocalization(map_, recording.device, options)
    moved_ns = int(where.times_ns[0]) + 3 * 10**9
    errors: dict[int, float] = {}
    is_moved = False
    for update in updates_of(odometry, EventStream(recording)):
        if update.time_ns >= moved_ns and not is_moved:
            map_.database.p_G[:] += shift
            is_moved = True
        pose = localization.after_frame(update, odometry.smoother).pose
        if pose is not None and is_moved:
            truth = where.T_G_I[np.searchsorted(where.times_ns, update.time_ns), 4:] + shift
            errors[update.time_ns] = float(np.linalg.norm(pose.T_G_I[4:] - truth))
    seconds = 1e-9 * (np.array(list(errors)) - moved_ns)
    error_m = np.array(list(errors.values()))
    assert error_m[0] > 1.5
    assert error_m[seconds > 1.5].max() < 0.1
    assert localization.counts.starts == 2
