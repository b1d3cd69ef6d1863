"""Localisation while a recording is replayed: all modes, wrong maps, wrong answers, late answers."""

import dataclasses

import numpy as np
import pytest

from maplab_py.array_types import F64
from maplab_py.errors import UserError
from maplab_py.frontend.localization.map_source import of_summary
from maplab_py.frontend.localization.online import OnlineLocalization
from maplab_py.frontend.localization.options import MODES, OnlineLocalizationOptions
from maplab_py.frontend.odometry import Odometry
from maplab_py.frontend.odometry_update import OdometryUpdate
from maplab_py.geometry import se3, so3
from maplab_py.interop.recordings.stream import EventStream
from maplab_py.storage.summary_map import SummaryMap
from tests.frontend.known_start import updates_of
from tests.frontend.localization.places import place, run, searched, summary

OPTIONS = OnlineLocalizationOptions()


def with_mode(mode: str, **changes: object) -> OnlineLocalizationOptions:
    return dataclasses.replace(OPTIONS, mode=mode, **changes)


def poses(updates: list[OdometryUpdate]) -> F64:
    return np.concatenate([u.state.T_M_I for u in updates if u.state is not None])


@pytest.mark.parametrize("mode", MODES)
def test_every_mode_knows_where_it_is(mode: str) -> None:
    localization, frames, _ = run(with_mode(mode))
    errors = place().errors_m(frames)
    assert len(errors) >= 0.8 * len(frames)
    assert np.median(errors) < (0.2 if mode == "odo" else 0.05)
    assert localization.counts.starts == 1
    assert localization.counts.answers_by_tracking > 0
    assert localization.problem == ""
    assert frames[-1].pose is not None


def test_uncertain_landmarks_are_estimated() -> None:
    options = with_mode("vil", landmark_uncertainty="map")
    _, frames, _ = run(options, searched(with_covariances=True))
    assert np.median(place().errors_m(frames)) < 0.05


def test_the_next_frame_confirms_an_answer_with_many_matches() -> None:
    from maplab_py.frontend.localization.map_source import of_map

    for searched_map, is_certain in ((of_map(place().vi_map, "map"), True), (searched(), False)):
        _, frames, _ = run(OPTIONS, searched_map)
        answers = [frame.answer for frame in frames if frame.answer is not None]
        assert (len(answers[0]) >= 30) is is_certain
        waited_s = 1e-9 * (answers[1].time_ns - answers[0].time_ns)
        frame_s = 1e-9 * (frames[1].time_ns - frames[0].time_ns)
        assert (waited_s < 1.5 * frame_s) is is_certain
        assert waited_s < 0.7
        localized = [f.time_ns for f in frames if f.pose is not None]
        assert localized[0] <= answers[2].time_ns


def test_the_index_alone_localises_too() -> None:
    localization, frames, _ = run(with_mode("vil", map_tracking=False))
    assert localization.counts.answers_by_tracking == 0
    assert localization.counts.answers_by_index >= 5
    assert np.median(place().errors_m(frames)) < 0.05


def test_answers_of_a_network_come_with_the_next_frame() -> None:
    localization, frames, _ = run(OPTIONS, features="xfeat")
    _, again, _ = run(OPTIONS, features="xfeat")
    answered = [row for row, frame in enumerate(frames) if frame.answer is not None]
    assert len(answered) > 5
    for row in answered:
        answer = frames[row].answer
        assert answer is not None
        assert answer.time_ns == frames[row - 1].time_ns
    assert localization.counts.late == 0
    assert np.median(place().errors_m(frames)) < 0.05
    for a, b in zip(frames, again, strict=True):
        assert (a.pose is None) == (b.pose is None)
        assert a.pose is None or b.pose is None or np.array_equal(a.pose.T_G_I, b.pose.T_G_I)


def test_the_same_run_gives_the_same_bytes() -> None:
    first, second = (run(OPTIONS)[1] for _ in range(2))
    for a, b in zip(first, second, strict=True):
        assert (a.pose is None) == (b.pose is None)
        if a.pose is not None and b.pose is not None:
            assert a.pose.T_G_I.tobytes() == b.pose.T_G_I.tobytes()
            assert a.pose.covariance.tobytes() == b.pose.covariance.tobytes()


@pytest.mark.parametrize("mode", ["swl", "pose", "odo"])
def test_baselines_do_not_change_the_odometry(mode: str) -> None:
    _, _, updates = run(with_mode(mode))
    odometry = Odometry(place().recording().device, make_starter=place().start)
    plain = list(updates_of(odometry, EventStream(place().recording())))
    assert poses(updates).tobytes() == poses(plain).tobytes()


# -- maps that are of no use ------------------------------------------------------------------------


def turned(q_A_G: F64) -> SummaryMap:
    plain = summary()
    return dataclasses.replace(
        plain,
        p_G=so3.rotate(q_A_G, plain.p_G).astype(np.float32),
        p_G_observer=so3.rotate(q_A_G, plain.p_G_observer).astype(np.float32),
    )


def elsewhere() -> SummaryMap:
    plain, rng = summary(), np.random.default_rng(3)
    order = rng.permutation(len(plain.descriptors))
    return dataclasses.replace(plain, descriptors=np.ascontiguousarray(plain.descriptors[order]))


def all_equal() -> SummaryMap:
    plain = summary()
    same = np.tile(plain.descriptors[:1], (len(plain.descriptors), 1))
    return dataclasses.replace(plain, descriptors=same)


@pytest.mark.parametrize(
    "changed", [turned(so3.exp([0.35, 0.0, 0.0])), elsewhere(), all_equal()],
    ids=["tilted", "another place", "descriptors all equal"],
)  # fmt: skip
def test_the_odometry_goes_on_in_a_map_of_no_use(changed: SummaryMap) -> None:
    localization, frames, updates = run(OPTIONS, of_summary(changed, "wrong"))
    assert all(frame.pose is None for frame in frames)
    assert localization.counts.starts == 0
    assert sum(localization.counts.refused.values()) == localization.counts.queries > 5
    _, _, plain = run(with_mode("odo"), of_summary(changed, "wrong"))
    assert poses(updates).tobytes() == poses(plain).tobytes()


def test_descriptors_of_another_size_are_told_in_one_line() -> None:
    plain = summary()
    assert plain.projection is not None
    longer = np.concatenate([plain.projection, plain.projection[:, :128]], axis=1)
    other = dataclasses.replace(plain, projection=np.ascontiguousarray(longer))
    localization, frames, updates = run(OPTIONS, of_summary(other, "long"))
    assert localization.problem == (
        "long: its descriptors have 64 bytes, those of the recording 48: make the map from "
        "recordings with the same descriptors"
    )
    assert localization.counts.queries == 1
    assert len(frames) == len(updates)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"projection": None}, "does not hold the projection"),
        ({"p_G": "nan"}, "landmark positions are not all finite"),
        ({"descriptors": "nan"}, "descriptors are not all finite"),
        ({"landmark_covariance": None}, "no covariances: give --vil_landmark_uncertainty=none"),
        ({"empty": True}, "no landmark"),
    ],
)
def test_a_map_that_cannot_be_searched_is_refused(changes: dict, message: str) -> None:
    plain = summary()
    if "empty" in changes:
        changed = dataclasses.replace(
            plain, p_G=plain.p_G[:0], descriptors=plain.descriptors[:0],
            landmark=plain.landmark[:0], observer=plain.observer[:0], landmark_covariance=None,
        )  # fmt: skip
    else:
        name, value = next(iter(changes.items()))
        if value == "nan":
            value = getattr(plain, name).copy()
            value[3, 0] = np.nan
        changed = dataclasses.replace(plain, **{name: value})
    with pytest.raises(UserError, match=message):
        of_summary(changed, "map", with_covariances=True)


def test_another_calibration_is_told() -> None:
    plain = summary()
    assert plain.sensors is not None
    device = place().recording().device
    camera = dataclasses.replace(device.cameras[0], intrinsics=device.cameras[0].intrinsics * 1.1)
    other = dataclasses.replace(searched(), sensors=None)
    assert OnlineLocalization(other, device, OPTIONS).notes == []
    from maplab_py.frontend.localization.map_source import calibration_notes

    rig = dataclasses.replace(device.rig, cameras=(camera, *device.cameras[1:]))
    sensors = dataclasses.replace(
        device.sensors, sensors={**device.sensors.sensors, device.rig_id: rig}
    )
    other = dataclasses.replace(searched(), sensors=sensors)
    assert "another calibration" in calibration_notes(other, device)[0]


def test_moving_the_map_moves_the_pose_and_nothing_else() -> None:
    """The frame G is a choice: a map that is turned about the vertical gives the same T_M_I."""
    q_A_G = so3.exp([0.0, 0.0, 1.0])
    _, frames, updates = run(OPTIONS)
    _, turned_frames, turned_updates = run(OPTIONS, of_summary(turned(q_A_G), "turned"))
    np.testing.assert_allclose(poses(turned_updates), poses(updates), atol=2e-3)
    a, b = frames[-1].pose, turned_frames[-1].pose
    assert a is not None
    assert b is not None
    T_A_G = se3.make(q_A_G, np.zeros(3))
    np.testing.assert_allclose(b.T_G_I[4:], se3.compose(T_A_G, a.T_G_I)[4:], atol=5e-3)
