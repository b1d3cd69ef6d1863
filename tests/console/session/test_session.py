"""Sessions, their settings, and those that watch them."""

import logging
from collections.abc import Callable
from pathlib import Path

import pytest

from maplab_py.console.commands.flags import DEPTH_LIMIT, read_flagfile
from maplab_py.console.session.maps import MapManager
from maplab_py.console.session.session import Session, Watchers
from maplab_py.console.session.settings import Layer
from maplab_py.errors import EstimationError, FlagError, MaplabError, UserError
from maplab_py.report import Message
from maplab_py.vimap import VIMap
from tests.console.sample_plugin import make_session, map_of


def test_commit_makes_the_new_value_and_undo_has_the_old() -> None:
    session = make_session()
    first = map_of(1)
    session.maps.add("a", first, is_saved=True)
    assert session.maps.selected.is_saved
    assert session.run("add_mission") == Message("2 missions")
    assert len(session.vi_map.missions) == 2
    assert not session.maps.selected.is_saved
    session.maps.update(session.maps.selected.undone())
    assert session.vi_map is first
    assert session.maps.selected.is_saved
    session.maps.update(session.maps.selected.redone())
    assert len(session.vi_map.missions) == 2


@pytest.mark.parametrize(
    ("how", "error"),
    [("user", UserError), ("estimation", EstimationError), ("program", ZeroDivisionError)],
)
def test_a_failed_command_leaves_every_map_as_it_was(how: str, error: type[Exception]) -> None:
    session = make_session()
    session.maps.add("a", map_of(1))
    before = session.maps.state
    with pytest.raises(error):
        session.run("fail_after_commit", how=how)
    assert session.maps.state is before


def test_a_command_that_needs_a_map_is_refused_without_one() -> None:
    session = make_session()
    with pytest.raises(UserError, match="no map is selected; load one"):
        session.run("add_mission")
    session.maps.add("a", VIMap())
    session.maps.add("b", VIMap())
    session.maps.remove("b")
    assert session.maps.selected_key == "a"


def test_keys_are_checked_and_proposed() -> None:
    maps = make_session().maps
    maps.add("euroc", VIMap())
    with pytest.raises(UserError, match="is in use"):
        maps.add("euroc", VIMap())
    with pytest.raises(UserError, match="cannot be a map key"):
        maps.add("a b", VIMap())
    with pytest.raises(UserError, match="did you mean euroc"):
        maps.select("eurok")
    assert maps.keys == ["euroc"]


def test_rename_keeps_place_and_selection() -> None:
    maps = make_session().maps
    for key in "abc":
        maps.add(key, VIMap(), select=False)
    maps.rename("a", "z")
    assert maps.keys == ["z", "b", "c"]
    assert maps.selected_key == "z"


def test_destructive_commands_are_refused_where_nobody_answers() -> None:
    session = make_session()
    with pytest.raises(UserError, match="give --yes"):
        session.run("destroy")
    assert session.run("destroy", yes=True) == Message("destroyed")


def test_mission_rows_take_prefixes() -> None:
    from maplab_py.console.session.context import CommandContext
    from maplab_py.progress import SILENT

    session = make_session()
    session.maps.add("a", map_of(3))
    context = CommandContext(session, SILENT, session.terminal)
    assert context.mission_rows() is None
    assert context.mission_rows("2") == [1]
    rows = context.mission_rows("", "3, 1")
    assert rows is not None
    assert rows.tolist() == [0, 2]
    with pytest.raises(UserError, match="no mission begins with 'f'"):
        context.mission_rows("f")
    with pytest.raises(UserError):
        context.mission_row("")


def test_timings_are_kept_even_of_failures() -> None:
    session = make_session()
    session.run("echo", "a")
    with pytest.raises(MaplabError):
        session.run("destroy")
    assert [timing.command for timing in session.timings] == ["echo", "destroy"]


def test_words_reach_a_variadic_command() -> None:
    session = make_session()
    assert session.run("echo", "a", "b c") == Message("a b c")
    assert session.execute(session.parse(["echo", "x", "y"])) == Message("x y")


def iterations(session: Session, words: str = "") -> int:
    report = session.execute(session.parse(f"solve {words}".split()))
    return int(report.options.num_iterations)  # type: ignore[attr-defined]


def flagfile(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(lines) + "\n")
    return path


def test_each_layer_beats_the_one_before(tmp_path: Path) -> None:
    session = make_session()
    assert iterations(session) == 10
    settings = session.settings
    settings.assign_file(flagfile(tmp_path / "user", "--ba_num_iterations=1"), Layer.USER_CONFIG)
    assert iterations(session) == 1
    settings.assign_file(flagfile(tmp_path / "start", "--ba_num_iterations=2"), Layer.START_UP)
    assert iterations(session) == 2
    session.set_flags(["--ba_num_iterations=3"])
    assert iterations(session) == 3
    own = flagfile(tmp_path / "own", "--ba_num_iterations=4")
    assert iterations(session, f"--flagfile={own}") == 4
    assert iterations(session, f"--ba_num_iterations=5 --flagfile={own}") == 5
    assert iterations(session) == 3


def test_a_commands_flags_are_gone_after_it_unless_kept() -> None:
    session = make_session()
    assert iterations(session, "--ba_num_iterations=7") == 7
    assert iterations(session) == 10
    assert iterations(session, "--ba_num_iterations=7 --keep_gflags") == 7
    assert iterations(session) == 7
    assert session.settings.current()["ba_num_iterations"].origin == "kept from solve"


def test_set_takes_all_or_nothing_and_unset_takes_back() -> None:
    session = make_session()
    with pytest.raises(FlagError, match="whole number"):
        session.set_flags(["ba_loss=none", "ba_num_iterations=x"])
    assert session.settings.current() == {}
    session.set_flags(["ba-loss=none", "--nofix_gravity", "--ba_num_iterations", "4"])
    texts = {name: setting.text for name, setting in session.settings.current().items()}
    assert texts == {"ba_loss": "none", "fix_gravity": "false", "ba_num_iterations": "4"}
    assert session.settings.unset("--ba-loss") is not None
    assert session.settings.unset("ba_loss") is None
    with pytest.raises(FlagError, match="did you mean --ba_loss"):
        session.settings.unset("ba_los")


@pytest.mark.parametrize("word", ["--nonsense_flag=1", "loose", "--keep_gflags", "--every=x"])
def test_set_refuses_what_is_no_flag_or_no_value(word: str) -> None:
    with pytest.raises(FlagError):
        make_session().set_flags([word])


def test_flag_files_nest_relative_to_the_including_file(tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    flagfile(tmp_path / "sub" / "inner", "--ba_loss='none'  # quoted", "", "// also a comment")
    outer = flagfile(tmp_path / "outer", "# first", "--flagfile=sub/inner", "--name 'a b'")
    lines = read_flagfile(outer)
    assert [line.words for line in lines] == [("--ba_loss=none",), ("--name", "a b")]
    assert lines[0].origin == f"{tmp_path / 'sub' / 'inner'}:1"


def test_flags_of_other_commands_in_a_commands_flag_file_are_passed_over(tmp_path: Path) -> None:
    path = flagfile(tmp_path / "f", "--every=3", "--ba_num_iterations=6")
    assert iterations(make_session(), f"--flagfile={path}") == 6


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("--ba_num_iteration=3", "did you mean"),
        ("--ba_num_iterations=x", "whole number"),
        ("solve", "not a flag"),
        ("--ba_loss='none", "unclosed"),
        ("--flagfile=missing", "cannot be read"),
        ("--flagfile", "needs a path"),
        ("--flagfile=$MAPLAB_TEST_UNSET_VARIABLE", "UNSET_VARIABLE is not set"),
    ],
)
def test_a_mistake_in_a_flag_file_names_file_and_line(
    tmp_path: Path, line: str, message: str
) -> None:
    path = flagfile(tmp_path / "f", "# comment", line)
    session = make_session()
    with pytest.raises(FlagError, match=message) as error:
        session.settings.assign_file(path, Layer.START_UP)
    assert message == "cannot be read" or f"{path}:2" in str(error.value)
    with pytest.raises(FlagError, match=message):
        session.parse(["solve", f"--flagfile={path}"])


def test_flag_files_in_a_circle_are_stopped(tmp_path: Path) -> None:
    path = flagfile(tmp_path / "f", "--flagfile=f")
    with pytest.raises(FlagError, match=f"more than {DEPTH_LIMIT} deep"):
        read_flagfile(path)


def test_binary_flag_file(tmp_path: Path) -> None:
    path = tmp_path / "f"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(FlagError, match="not a text file"):
        read_flagfile(path)


class Restless:
    """Fails while it is told to."""

    fails = True

    def after_command(self, maps: MapManager) -> None:
        self._look()

    def during_command(self, make_map: Callable[[], VIMap]) -> None:
        self._look()

    def close(self) -> None:
        self._look()

    def _look(self) -> None:
        if self.fails:
            raise RuntimeError("eyes shut")


def test_the_user_is_told_once_until_it_follows_again(caplog: pytest.LogCaptureFixture) -> None:
    told: list[str] = []
    watchers, watcher, maps = Watchers(told.append), Restless(), MapManager()
    watchers.set("viewer", watcher)
    with caplog.at_level(logging.ERROR):
        for _ in range(3):
            watchers.during_command(lambda: pytest.fail("nobody needs the map"))
            watchers.after_command(maps)
    assert len(told) == 1
    assert told[0].startswith("the viewer could not follow the map (see ")
    assert len(caplog.records) == 6
    assert "eyes shut" in caplog.text
    watcher.fails = False
    watchers.after_command(maps)
    watcher.fails = True
    watchers.after_command(maps)
    assert len(told) == 2
    watchers.close()
    assert watchers.find("viewer", Restless) is None
