"""Nonsense typed at the console: one line of answer, never a traceback, never a changed map."""

from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from maplab_py.console.commands.flags import read_flagfile
from maplab_py.console.commands.registry import load_registry
from maplab_py.console.prompt.completion import complete
from maplab_py.console.scripts.runner import Runner
from maplab_py.console.session.session import Session
from maplab_py.console.session.settings import Layer
from maplab_py.console.session.status import Status
from maplab_py.console.terminal.output import ConsoleTerminal
from maplab_py.errors import UserError
from maplab_py.vimap import VIMap

REGISTRY = load_registry()
EMPTY, OTHER = VIMap(), VIMap()
FLAGS = sorted(REGISTRY.all_flags())

# Commands that would run long, write files or start programs are typed with flags that no command
# has, so that they are refused.
HARMLESS = sorted(
    name
    for name in REGISTRY.names
    if not REGISTRY.find(name).acts_outside
    and not REGISTRY.find(name).writes_files
    and not REGISTRY.find(name).name.startswith("load")
)
ODD_TEXT = st.text(
    alphabet=st.characters(codec="utf-8", exclude_characters="|!&$", exclude_categories=["Cs"]),
    max_size=12,
)
VALUES = st.one_of(
    ODD_TEXT,
    st.sampled_from(["", "0", "-1", "1e400", "nan", "true", "no", ",", "=", "--", "'", '"', "\\"]),
    st.integers().map(str),
    st.floats().map(str),
)
FLAG = st.one_of(st.sampled_from(FLAGS), ODD_TEXT)
WORDS = st.one_of(
    VALUES,
    st.builds(lambda f: f"--{f}", FLAG),
    st.builds(lambda f: f"--no{f}", FLAG),
    st.builds(lambda f, v: f"--{f}={v}", FLAG, VALUES),
    st.builds(lambda f, v: f"-{f} {v}", FLAG, VALUES),
    st.builds(lambda f: f"--{f.replace('_', '-')}", st.sampled_from(FLAGS)),
)
COMMANDS = st.one_of(st.sampled_from(HARMLESS), ODD_TEXT)
LINES = st.builds(lambda c, words: " ".join([c, *words]), COMMANDS, st.lists(WORDS, max_size=4))
REFUSED = st.builds(
    lambda c, words: " ".join([c, *words, "--no_such_flag_at_all"]),
    st.sampled_from(REGISTRY.names),
    st.lists(
        st.builds(lambda f, v: f"--{f}='{v}'", st.sampled_from(FLAGS), st.integers().map(str)),
        max_size=3,
    ),
)


def make_runner() -> Runner:
    terminal = ConsoleTerminal(as_json=True)
    session = Session(REGISTRY, terminal)
    session.maps.add("empty", EMPTY, is_saved=True)
    session.maps.add("other", OTHER, is_saved=True, select=False)
    return Runner(session, terminal)


def check_line(line: str, capsys: pytest.CaptureFixture[str]) -> Status:
    """Type a line: a failure must say why in short lines and leave everything as it was."""
    runner = make_runner()
    state = runner.session.maps.state
    status = runner.run_text(line)
    out, err = capsys.readouterr()
    assert "Traceback" not in out + err, line
    assert "an error of the program" not in err, line
    assert status in set(Status)
    if status == Status.USER_ERROR and ";" not in line and "\n" not in line:
        assert runner.session.maps.state is state, line
        assert runner.session.settings.current() == {}, line
        assert err.startswith("error: "), line
    return status


@pytest.fixture(scope="module")
def flagfile(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("flags") / "f.flags"


def check_flagfile(path: Path, text: str) -> None:
    """Read a text as a flag file: it gives flags, or one error that names the file."""
    path.write_text(text, encoding="utf-8")
    session = Session(REGISTRY)
    problem = ""
    try:
        read_flagfile(path)
        session.settings.assign_file(path, Layer.START_UP)
    except UserError as error:
        problem = str(error)
    assert "f.flags" in problem or not problem
    assert "\n" not in problem


def check_completion(line: str) -> None:
    """Complete after every prefix of a line."""
    session = make_runner().session
    for end in range(len(line) + 1):
        for candidate in complete(line[:end], session):
            assert 0 <= candidate.start <= end


FLAG_LINES = st.lists(
    st.one_of(
        st.builds(lambda f, v: f"--{f}={v}", FLAG, VALUES),
        st.builds(lambda f: f"--{f}", FLAG),
        ODD_TEXT,
        st.sampled_from(["# a comment", "--flagfile=f.flags", "--flagfile=", "//x", "--flagfile"]),
    ),
    max_size=4,
).map("\n".join)
MANY = max(300, settings().max_examples)  # --hypothesis-profile=search asks for more
IN_ONE_PLACE = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow]


@given(LINES)
@settings(max_examples=MANY, suppress_health_check=IN_ONE_PLACE)
def test_lines(capsys: pytest.CaptureFixture[str], line: str) -> None:
    check_line(line, capsys)


@given(REFUSED)
@settings(max_examples=MANY, suppress_health_check=IN_ONE_PLACE)
def test_a_refused_line_changes_nothing(capsys: pytest.CaptureFixture[str], line: str) -> None:
    assert check_line(line, capsys) == Status.USER_ERROR


@given(FLAG_LINES)
@settings(max_examples=MANY)
def test_flag_files(flagfile: Path, text: str) -> None:
    check_flagfile(flagfile, text)


@given(LINES)
@settings(max_examples=20)
def test_completion_and_colours(line: str) -> None:
    check_completion(line)
