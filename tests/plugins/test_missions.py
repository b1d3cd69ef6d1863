"""Removal of missions, by ids and by questions, and the state of base frames."""

import pytest
from maplab_plugins.visualization.following import Following

from maplab_py.console.session.session import Session
from maplab_py.console.terminal.protocol import SilentTerminal
from maplab_py.errors import Cancelled, UserError
from maplab_py.vimap import mission_labels, to_hex
from tests.console.sample_plugin import map_of
from tests.vimap.builders import walk_map


@pytest.fixture
def session() -> Session:
    session = Session()
    session.maps.add("a", map_of(3))
    return session


def known(session: Session) -> list[bool]:
    vi_map = session.vi_map
    return [bool(k) for k in vi_map.baseframes.is_known[vi_map.missions.baseframe]]


def test_one_base_frame_by_prefix_and_the_first_without(session: Session) -> None:
    session.run("sbk", map_mission="2")
    assert known(session) == [False, True, False]
    report = session.run("set_mission_baseframe_to_known")
    assert known(session) == [True, True, False]
    assert "1000" in report.text  # type: ignore[attr-defined]
    session.run("set_mission_baseframe_to_unknown", map_mission="2")
    assert known(session) == [True, False, False]


@pytest.mark.parametrize("command", ["sbk", "set_mission_baseframe_to_unknown", "rm"])
def test_a_wrong_mission_is_an_error_and_not_the_first_one(session: Session, command: str) -> None:
    before = session.vi_map
    with pytest.raises(UserError, match="no mission begins with 'f00'"):
        session.run(command, map_mission="f00")
    assert session.vi_map is before


def test_remove_missions(session: Session) -> None:
    with pytest.raises(UserError, match="no mission is given"):
        session.run("remove_mission")
    with pytest.raises(UserError, match="--yes"):
        session.run("remove_mission", map_mission="1")
    session.run("remove_mission", map_mission_list="1,3", yes=True)
    assert len(session.vi_map.missions) == 1
    session.run("undo")
    assert len(session.vi_map.missions) == 3


def test_a_mission_is_renamed_and_found_by_its_name(session: Session) -> None:
    report = session.run("rename_mission", "monday", map_mission="2")
    assert report.text.endswith("to 'monday'")  # type: ignore[attr-defined]
    assert list(session.vi_map.missions.name) == ["", "monday", ""]
    session.run("sbk", map_mission="mon")
    assert known(session) == [False, True, False]
    session.run("undo")
    session.run("undo")
    assert list(session.vi_map.missions.name) == ["", "", ""]


def test_wrong_names(session: Session) -> None:
    session.run("rename_mission", "monday", map_mission="2")
    with pytest.raises(UserError, match="another mission is named 'monday'"):
        session.run("rename_mission", "monday", map_mission="1")
    with pytest.raises(UserError, match="cannot be a name"):
        session.run("rename_mission", "a,b", map_mission="1")
    with pytest.raises(UserError, match="--map_mission is empty"):
        session.run("rename_mission", "tuesday")
    with pytest.raises(UserError, match=r"no mission begins with 'wed'.*monday \(2000\)"):
        session.run("sbk", map_mission="wed")


class Answering(SilentTerminal):
    """A terminal at which the given answers are typed, then Ctrl-C."""

    is_interactive = True  # type: ignore[assignment]

    def __init__(self, *answers: str) -> None:
        self.answers = list(answers)
        self.questions: list[str] = []
        self.notes: list[str] = []
        self.during: list[object] = []
        self.session: Session | None = None

    def choose(self, question: str, answers: tuple[str, ...]) -> str:
        self.questions.append(question)
        if self.session is not None:
            following = self.session.watchers.find("viewer", Following)
            assert following is not None
            self.during.append(following.viewer.wanted)
        if not self.answers:
            raise Cancelled("cancelled")
        assert self.answers[0] in answers
        return self.answers.pop(0)

    def note(self, text: str) -> None:
        self.notes.append(text)


def session_with(*answers: str) -> tuple[Session, Answering]:
    terminal = Answering(*answers)
    session = Session(terminal=terminal)
    session.maps.add("a", map_of(3))
    return session, terminal


def missions(session: Session) -> list[str]:
    return [to_hex(words)[:4] for words in session.vi_map.missions.id]


def test_the_missions_that_the_user_names_are_removed_in_one_step() -> None:
    session, terminal = session_with("yes", "no", "yes")
    before = session.vi_map
    names = missions(session)
    report = session.run("remove_mission_interactive")
    assert missions(session) == names[1:2]
    assert report.text.startswith("removed 2 missions: ")  # type: ignore[attr-defined]
    assert terminal.notes[0].startswith("mission 1 of 3: without a name, id ")
    assert terminal.questions == [f"remove mission {name}?" for name in mission_labels(before)]
    session.run("undo")
    assert session.vi_map is before


def test_quit_removes_what_was_chosen_and_keeps_the_rest() -> None:
    session, terminal = session_with("yes", "quit")
    names = missions(session)
    session.run("rmi")
    assert missions(session) == names[1:]
    assert len(terminal.questions) == 2


def test_nothing_changes_without_a_yes_and_after_ctrl_c() -> None:
    session, _ = session_with("no", "no", "no")
    before = session.vi_map
    assert session.run("rmi").text == "no mission is removed"  # type: ignore[attr-defined]
    assert session.vi_map is before
    session, terminal = session_with("yes", "yes")
    before = session.vi_map
    with pytest.raises(Cancelled):
        session.run("rmi")
    assert len(terminal.questions) == 3
    assert session.vi_map is before


def test_only_some_missions_are_asked_about_and_named() -> None:
    session, terminal = session_with("yes")
    session.run("rename_mission", "monday", map_mission="2")
    report = session.run("rmi", map_mission_list="monday")
    assert report.text == "removed 1 mission: monday"  # type: ignore[attr-defined]
    assert terminal.questions == ["remove mission monday?"]
    assert terminal.notes[0].startswith("mission 1 of 1: monday, id 2000")


def test_scripts_are_refused_in_one_line_and_dry_runs_ask_nothing() -> None:
    session = Session()
    session.maps.add("a", map_of(3))
    with pytest.raises(
        UserError, match="nobody is there to answer; in a script use remove_mission"
    ):
        session.run("rmi")
    session, terminal = session_with()
    assert session.run("rmi", dry_run=True).text == "would ask about 3 missions"  # type: ignore[attr-defined]
    assert terminal.questions == []


def test_a_running_viewer_shows_the_mission_and_then_the_map_again() -> None:
    terminal = Answering("no", "no")
    with Session(terminal=terminal) as session:
        session.set_flags(["--viewer_port=0"])
        session.maps.add("walk", walk_map())
        session.maps.add("other", walk_map(vertices=7, seed=4))
        session.run("merge_map", "walk")
        session.run("visualize", viewer_open_page=False)
        before = session.vi_map
        terminal.session = session
        session.run("rmi")
        sizes = [len(subject.vi_map.vertices) for subject in terminal.during]  # type: ignore[attr-defined]
        assert sorted(sizes) == [7, 12]
        following = session.watchers.find("viewer", Following)
        assert following is not None
        assert following.viewer.wanted is not None
        assert following.viewer.wanted.vi_map is before
