"""Lasting flags: files, layers, set, unset, --keep_gflags."""

from __future__ import annotations

from pathlib import Path

import pytest

from maplab_py.console.commands.flagfile import DEPTH_LIMIT, read_flagfile
from maplab_py.console.session.session import Session
from maplab_py.console.session.settings import Layer
from maplab_py.errors import FlagError
from tests.console.sample_plugin import make_session


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
