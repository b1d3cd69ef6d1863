"""What every command owes its user; holds for commands that are yet to be written."""

import json
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from maplab_py.console.commands.lines import split_commands
from maplab_py.console.commands.registry import load_registry
from maplab_py.console.commands.schema import line_schema
from maplab_py.console.scripts.runner import Runner
from maplab_py.console.session.maps import MapsState
from maplab_py.console.session.session import Refusal, Session
from maplab_py.console.session.status import Status
from maplab_py.console.terminal.output import ConsoleTerminal
from maplab_py.vimap import MissionSensor, to_hex
from tests.registry import workspace
from tests.support.data import REPOSITORY

Capture = pytest.CaptureFixture[str]

REGISTRY = load_registry()
COMMANDS = [command for command in REGISTRY.commands if REGISTRY.is_built_in(command)]
NAMES = [
    pytest.param(c.name, marks=pytest.mark.slow if c.name in workspace.SLOW else ())
    for c in COMMANDS
    if c.name not in workspace.WITH_ROBOT
]
ALL_NAMES = [command.name for command in COMMANDS]


class _Agreeing(ConsoleTerminal):
    """A terminal at which somebody answers every question with the first answer."""

    @property
    def is_interactive(self) -> bool:
        return True

    def choose(self, question: str, answers: tuple[str, ...]) -> str:
        assert question
        return answers[0]


class _Writes:
    """Files opened for writing while it is active; an audit hook cannot be taken off again."""

    def __init__(self) -> None:
        self.active = False
        self.paths: list[str] = []
        sys.addaudithook(self._hook)

    def _hook(self, event: str, arguments: tuple[Any, ...]) -> None:
        if self.active and event == "open" and isinstance(arguments[0], str):
            mode = str(arguments[1] or "")
            if any(letter in mode for letter in "wax+"):
                self.paths.append(arguments[0])
        elif self.active and event == "os.remove" and arguments[1] != -1:
            pass  # relative to a folder that shutil.rmtree has named
        elif self.active and event in ("os.rename", "os.mkdir", "os.remove", "shutil.rmtree"):
            self.paths.append(str(arguments[0]))


WRITES = _Writes()


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("workspace")
    workspace.make_workspace(folder)
    return folder


@pytest.fixture
def bare(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Runner]:
    """Return a runner in an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    terminal = ConsoleTerminal(as_json=True)
    yield Runner(Session(REGISTRY, terminal), terminal)
    terminal.transcribe(None)


@pytest.fixture
def runner(bare: Runner, original: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Runner:
    """Return a runner in a fresh copy of the workspace."""
    shutil.copytree(original, tmp_path / "here")
    monkeypatch.chdir(tmp_path / "here")
    return bare


def prepare(runner: Runner, name: str, capsys: Capture) -> str:
    """Type what must precede the command's example; return the example."""
    assert runner.run_text(workspace.lines_before(name)) == Status.OK, capsys.readouterr().err
    capsys.readouterr()
    example = workspace.OTHER_EXAMPLES.get(name, REGISTRY.find(name).example)
    if name == "tour":  # somebody has to type
        runner.terminal.is_prompt = True
    if name == "remove_mission_interactive":  # somebody has to answer
        runner.terminal.__class__ = _Agreeing
    if name == "recover":  # what a script has left
        assert runner.run_text("load maps/v1_01; elq") == Status.OK
        assert runner.finish(discard=False) == Status.USER_ERROR
        assert runner.run_text("delete_map --yes") == Status.OK
        capsys.readouterr()
    if name == "fix":  # what a refusal has left
        runner.session.refusal = Refusal("map_stats", "elq")
    if name in (
        "remove_loopclosure",
        "judge_closures",
    ):  # whose argument is an id that nobody knows beforehand
        closures = runner.session.run("lc_report").as_dict()["closures"]
        example = example.replace("59f0a1b2", closures[0]["id"])
    if name == "import_point_clouds":  # likewise
        imu_id = to_hex(runner.session.vi_map.missions.sensor_id[0, MissionSensor.IMU])
        example = example.replace("5c1a", imu_id)
    return example


@pytest.mark.parametrize("name", ALL_NAMES)
def test_its_help_says_what_it_does_and_what_each_flag_is(name: str) -> None:
    command = REGISTRY.find(name)
    assert command.summary.endswith(".")
    assert len(command.summary) <= 100
    assert [flag.name for flag in command.flags.values() if len(flag.help) < 5] == []
    assert [flag.name for flag in command.flags.values() if flag.help.endswith(".")] == []
    for other in command.see_also:
        assert REGISTRY.find(other).name == other
    assert REGISTRY.find(split_commands(command.example)[0][0]) is command
    page = (REPOSITORY / "docs" / "commands" / f"{REGISTRY.owner(command)}.md").read_text()
    assert f"\n## {name}\n" in page


@pytest.mark.parametrize("name", NAMES)
def test_its_example_runs_and_can_be_tried_and_undone(
    runner: Runner, name: str, capsys: Capture
) -> None:
    example = prepare(runner, name, capsys)
    state = runner.session.maps.state
    fingerprint = workspace.digest(dict(state.entries))
    command = REGISTRY.find(name)
    if not command.acts_outside or command.obeys_dry_run:
        try_out(runner, name, example.replace(" --dry_run", ""), capsys)
    assert runner.run_text(example) == Status.OK, capsys.readouterr().err
    assert workspace.digest(dict(state.entries)) == fingerprint, (
        "the command wrote into a map's arrays"
    )
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    check_schema([line for line in lines if line["command"] == name])
    if name not in ("undo", "redo", "select_map"):
        undo_and_redo(runner, state)


def check_schema(lines: list[Any]) -> None:
    """Compare what a command printed with what its schema promises."""
    assert len(lines) == 1
    schema = line_schema([REGISTRY.find(lines[0]["command"])])
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.validate(lines[0], schema)


def try_out(runner: Runner, name: str, line: str, capsys: Capture) -> None:
    """Run a line with --dry_run: no map and no file may change."""
    state = runner.session.maps.state
    WRITES.paths.clear()
    WRITES.active = True
    try:
        status = runner.run_text(line + " --dry_run")
    finally:
        WRITES.active = False
    assert status == Status.OK, capsys.readouterr().err
    capsys.readouterr()
    assert runner.session.maps.state is state
    inside = [path for path in WRITES.paths if _is_below(path, Path.cwd())]
    assert inside == [], (
        f"{name} writes files: write through maplab_py.output_files, or mark it with acts_outside=True"
    )


def undo_and_redo(runner: Runner, before: MapsState) -> None:
    """Undo must bring the very value back that was there before, redo that after."""
    key, maps = before.selected, runner.session.maps
    if key not in maps or maps.get(key).vi_map is before.entries[key].vi_map:
        return
    after = maps.get(key).vi_map
    assert runner.run_text(f"select_map {key}; undo") == Status.OK
    assert maps.get(key).vi_map is before.entries[key].vi_map
    assert runner.run_text("redo") == Status.OK
    assert maps.get(key).vi_map is after


def test_most_editing_commands_edit_in_their_examples(runner: Runner, capsys: Capture) -> None:
    """Guard the test before this one against examples that do nothing."""
    assert runner.run_text(workspace.MERGED) == Status.OK
    before = runner.session.vi_map
    fingerprint = workspace.digest(before)
    for line in ("rlq", "sbk --map_mission=59f0", "optvi --ba_num_iterations=1", "rtl", "kfh"):
        assert runner.run_text(line) == Status.OK
        assert workspace.digest(runner.session.vi_map) != fingerprint, line
        assert runner.run_text("undo") == Status.OK
        assert runner.session.vi_map is before
    assert workspace.digest(before) == fingerprint
    capsys.readouterr()


def _is_below(path: str, folder: Path) -> bool:
    absolute = Path(path).absolute()
    return absolute.is_relative_to(folder) and "__pycache__" not in absolute.parts


@pytest.mark.parametrize("name", ALL_NAMES)
def test_a_wrong_flag_is_refused_in_one_line(bare: Runner, name: str, capsys: Capture) -> None:
    bare.session.maps.add("empty", _empty())
    state = bare.session.maps.state
    assert bare.run_text(f"{name} --no_such_flag=1") == Status.USER_ERROR
    out, err = capsys.readouterr()
    assert "no_such_flag" in err
    assert len(err.splitlines()) == 1
    (line,) = out.splitlines()
    assert json.loads(line)["status"] == 2
    assert bare.session.maps.state is state
    assert bare.session.settings.current() == {}


@pytest.mark.parametrize("name", [command.name for command in COMMANDS if command.needs_map])
def test_without_a_map_it_says_so(bare: Runner, name: str, capsys: Capture) -> None:
    command = REGISTRY.find(name)
    assert bare.run_text(command.example) == Status.USER_ERROR
    assert "no map is selected; load one" in capsys.readouterr().err
    assert len(bare.session.maps) == 0


def _empty() -> Any:
    from maplab_py.vimap import VIMap

    return VIMap()
