"""The anchoring commands, through the session."""

import numpy as np
import pytest

from maplab_py.console.session.session import Session
from maplab_py.errors import UserError
from maplab_py.vimap.ids import to_hex
from tests.algorithms.loop_closure.rooms import Walk, make_map

WALKS = [Walk(room=1), Walk(room=1, mission=1), Walk(room=1, mission=2)]


def session_of(*, known: list[bool]) -> Session:
    vi_map = make_map(WALKS)[0]
    T_G_M = vi_map.baseframes.T_G_M + np.where(known, 0.0, 5.0)[:, None] * np.eye(7)[5]
    frames = vi_map.baseframes.replace(T_G_M=T_G_M, is_known=np.array(known))
    session = Session()
    session.maps.add("rooms", vi_map.replace(baseframes=frames))
    return session


def test_one_mission_is_anchored() -> None:
    session = session_of(known=[True, False, False])
    name = to_hex(session.vi_map.missions.id[2])
    report = session.run("am", map_mission=name[:8])
    assert report.anchored == (name[:8],)
    assert session.vi_map.baseframes.is_known.tolist() == [True, False, True]
    with pytest.raises(UserError):
        session.run("am", map_mission="xyz")


# mission 0 was in a room, mission 1 in its twin, mission 2 in both, which are 9 m apart
TWINS = [
    Walk(room=1),
    Walk(room=1, mission=1, room_at=(0.0, 9.0, 0.0)),
    Walk(room=1, mission=2),
    Walk(room=1, mission=2, start_s=40.0, room_at=(0.0, 9.0, 0.0)),
]


def twins() -> tuple[Session, list[str]]:
    """Return a session with the twins, of which mission 2 is known, and the missions' names."""
    vi_map = make_map(TWINS)[0]
    frames = vi_map.baseframes.replace(is_known=np.array([False, False, True]))
    session = Session()
    session.maps.add("twins", vi_map.replace(baseframes=frames))
    return session, [to_hex(words)[:8] for words in vi_map.missions.id]


@pytest.mark.parametrize("y", [0.0, 9.0])
def test_a_person_decides_by_the_number_of_an_alignment(y: float) -> None:
    session, names = twins()
    listed = session.run("aam").hypotheses
    number = next(
        h.number
        for h in listed
        if h.missions == f"{names[0]} - {names[2]}" and abs(h.position_m[1] - y) < 1.0
    )
    report = session.run("aam", anchor_hypothesis=number)
    assert report.anchored == (names[0],)
    np.testing.assert_allclose(session.vi_map.T_G_M[0, 4:], [0.0, y, 0.0], atol=0.05)
    assert report.hypotheses[number - 1].outcome == "wins"
    assert session.vi_map.baseframes.is_known.tolist() == [True, False, True]


def test_a_pose_is_taken_as_it_is_without_a_mission_to_compare_with() -> None:
    session, names = twins()
    report = session.run("am", map_mission=names[1], T_G_M="1, 2, 0.5, 90")
    assert report.anchored == (names[1],)
    assert "not compared" in report.notes[0]
    np.testing.assert_allclose(
        session.vi_map.T_G_M[1], [0, 0, np.sqrt(0.5), np.sqrt(0.5), 1, 2, 0.5]
    )


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ({"T_G_M": "1 2 3"}, "four numbers are expected"),
        ({"T_G_M": "1 2 3 north"}, "four numbers are expected"),
        ({"T_G_M": "1 2 3 nan"}, "four numbers are expected"),
        ({"to": 2}, "give the approximate pose"),
        ({"to": 1, "T_G_M": "0 0 0 0"}, "its base frame is unknown"),
        ({"to": 2, "T_G_M": "0 4.5 0 90"}, "no alignment with the mission of --to is near"),
        ({"anchor_hypothesis": 99}, "--anchor_hypothesis=99: the alignments are from 1 to"),
    ],
)
def test_a_decision_that_cannot_be_is_one_line(flags: dict[str, object], message: str) -> None:
    session, names = twins()
    before = session.vi_map
    if "to" in flags:
        flags = {**flags, "to": names[flags["to"]]}
    with pytest.raises(UserError, match=message):
        session.run("am", map_mission=names[0], **flags)
    assert session.vi_map is before


def test_a_known_base_frame_is_not_given_again() -> None:
    session, names = twins()
    with pytest.raises(UserError, match="known already"):
        session.run("am", map_mission=names[2], T_G_M="0 0 0 0")
