"""Scripts and batch files: status, output, folders with any name."""

import io
import json
from pathlib import Path

import pytest

from maplab_py.console.main import parse_arguments
from maplab_py.console.scripts.batch import (
    FOLDER_TEMPLATE,
    Batch,
    read_batch,
    read_script,
    run_batch,
)
from maplab_py.console.scripts.runner import Runner, format_seconds
from maplab_py.console.session.session import Session
from maplab_py.console.session.status import Status
from maplab_py.console.terminal.output import ConsoleTerminal
from maplab_py.errors import FlagError, UserError
from maplab_py.storage.native import save_map
from tests.console.sample_plugin import make_registry, map_of
from tests.vimap.builders import walk_map

Capture = pytest.CaptureFixture[str]


def make_runner(*, as_json: bool = False) -> Runner:
    terminal = ConsoleTerminal(as_json=as_json)
    return Runner(Session(make_registry(), terminal), terminal)


@pytest.mark.parametrize(
    ("text", "status"),
    [
        ("echo a; echo b", Status.OK),
        ("", Status.OK),
        ("find_nothing", Status.FAILED),
        ("nosuch", Status.USER_ERROR),
        ("solve --nosuch=1", Status.USER_ERROR),
        ("echo 'a", Status.USER_ERROR),
        ("add_mission", Status.USER_ERROR),
        ("destroy", Status.USER_ERROR),
        ("find_nothing; nosuch", Status.FAILED),
        ("quit; nosuch", Status.OK),
    ],
)
def test_statuses(text: str, status: Status) -> None:
    assert make_runner().run_text(text) == status


def test_ctrl_c_that_cuts_a_report_does_not_deny_what_was_done(
    monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    runner = make_runner()
    runner.session.maps.add("a", map_of(1))
    monkeypatch.setattr(runner.terminal, "show", interrupted)
    assert runner.run_text("add_mission; add_mission") == Status.CANCELLED
    assert len(runner.session.maps.selected.vi_map.missions) == 2
    err = capsys.readouterr().err
    assert "error: add_mission: finished before Ctrl-C; the following commands are not run" in err
    assert "as before" not in err


@pytest.mark.parametrize(("how", "status"), [("user", 2), ("estimation", 1), ("program", 1)])
def test_errors_are_one_line(how: str, status: int, capsys: Capture) -> None:
    runner = make_runner()
    runner.session.maps.add("a", map_of(1))
    assert runner.run_text(f"fail_after_commit --how={how}") == status
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: fail_after_commit: ")
    assert len(err.splitlines()) == 1
    assert runner.run_text("echo still here") == Status.OK


def test_stops_at_the_first_failure_unless_told_to_go_on(capsys: Capture) -> None:
    assert make_runner().run_text("echo a; nosuch; echo b") == Status.USER_ERROR
    assert capsys.readouterr().out == "a\n"
    assert make_runner().run_text("echo a; nosuch; echo b", keep_going=True) == Status.USER_ERROR
    out, err = capsys.readouterr()
    assert out == "a\nb\n"
    assert "1 of 3 commands failed" in err


def test_json_goes_to_standard_output_and_nothing_else_does(capsys: Capture) -> None:
    make_runner(as_json=True).run_text(
        "solve --colour=deep_blue --folder=a; echo x", keep_going=True
    )
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [line["command"] for line in lines] == ["solve", "echo"]
    assert lines[0]["report"]["colour"] == "deep_blue"
    assert lines[0]["report"]["options"]["num_iterations"] == 10
    assert lines[1]["report"] == {"text": "x"}


def test_output_without_a_terminal_has_no_control_codes(capsys: Capture) -> None:
    make_runner().run_text("help; help solve; plugins; nosuch", keep_going=True)
    out, err = capsys.readouterr()
    assert "\x1b" not in out + err
    assert "--ba_tolerance_m" in out


def test_help_flag_is_help_of_the_command(capsys: Capture) -> None:
    runner = make_runner()
    runner.run_text("solve --help")
    first = capsys.readouterr().out
    runner.run_text("help s")
    assert capsys.readouterr().out == first
    assert "Pretend to solve." in first
    runner.run_text("set --help")
    assert "set" in capsys.readouterr().out


def test_unsaved_changes_are_an_error_unless_discarded(capsys: Capture) -> None:
    runner = make_runner()
    assert runner.finish(discard=False) == Status.OK
    runner.session.maps.add("a", map_of(1))
    assert runner.finish(discard=False) == Status.USER_ERROR
    assert "unsaved changes are lost: a" in capsys.readouterr().err  # there is no command `save`
    assert runner.finish(Status.FAILED, discard=False) == Status.FAILED
    assert runner.finish(discard=True) == Status.OK


def test_questions_are_answered_on_the_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    for answer, status in (
        ("y\n", Status.OK),
        ("no\n", Status.USER_ERROR),
        ("", Status.USER_ERROR),
    ):
        runner = make_runner()
        monkeypatch.setattr(ConsoleTerminal, "is_interactive", property(lambda self: True))
        monkeypatch.setattr("sys.stdin", io.StringIO(answer))
        assert runner.run_text("destroy") == status


def test_transcript_has_what_was_typed_and_printed(tmp_path: Path) -> None:
    runner = make_runner()
    path = tmp_path / "session.txt"
    runner.run_text(f"transcript {path}; echo hello; nosuch", keep_going=True)
    runner.run_text("transcript; echo silent")
    text = path.read_text()
    assert "> echo hello\nhello\n" in text
    assert "error: unknown command 'nosuch'" in text
    assert "silent" not in text
    assert runner.run_text(f"transcript {tmp_path}") == Status.USER_ERROR


def test_console_commands(capsys: Capture) -> None:
    runner = make_runner()
    runner.run_text("set ba_loss=none; flags; flags ba_num; unset ba_loss; flags; set; timing")
    out = capsys.readouterr().out
    assert "--ba_loss  none   set" in out
    assert "--ba_num_iterations  10     default  solve" in out
    assert out.count("all flags have their defaults") == 2
    assert "\nunset --ba_loss\n" in out
    assert runner.run_text("unset ba_loss") == Status.USER_ERROR
    assert runner.run_text("unset") == Status.USER_ERROR
    assert runner.run_text("help --plugin=nosuch") == Status.USER_ERROR
    assert runner.run_text("help --command_filter=zzz") == Status.USER_ERROR
    assert runner.run_text("help --all --plugin=console") == Status.OK


def test_watch_repeats_and_reports_the_commands_failure(capsys: Capture) -> None:
    runner = make_runner()
    assert runner.run_text("watch 'echo tick; echo tock' --every=0 --repetitions=3") == Status.OK
    assert capsys.readouterr().out.count("tick\ntock\n") == 3
    assert runner.run_text("watch nosuch") == Status.USER_ERROR
    assert runner.run_text("watch ''") == Status.USER_ERROR
    assert runner.run_text("watch echo --every=-1") == Status.USER_ERROR


def test_the_sheep_comes_and_goes() -> None:
    runner = make_runner()
    runner.run_text("sheep")
    assert runner.session.marks["sheep"] == "\N{SHEEP}"
    runner.run_text("enable_sheep")
    assert runner.session.marks["sheep"] == ""


def test_batch_runs_the_commands_for_each_folder(tmp_path: Path, capsys: Capture) -> None:
    path = tmp_path / "batch.yaml"
    path.write_text(
        "vi_map_folder_paths: [a b, c]\ncommands:\n  - echo --  <CURRENT_VIMAP_FOLDER>/x\n"
    )
    batch = read_batch(path)
    assert run_batch(batch, make_runner, keep_going=False, discard=False) == Status.OK
    assert capsys.readouterr().out == "a b/x\nc/x\n"


def test_batch_stops_unless_told_to_go_on(capsys: Capture) -> None:
    batch = Batch(("a", "b"), ("echo <CURRENT_VIMAP_FOLDER>", "find_nothing", "echo end"))
    assert run_batch(batch, make_runner, keep_going=False, discard=False) == Status.FAILED
    assert "b\n" not in capsys.readouterr().out
    assert run_batch(batch, make_runner, keep_going=True, discard=False) == Status.FAILED
    out, err = capsys.readouterr()
    assert out.count("end\n") == 2
    assert "2 map folders, 2 failed" in err


def test_the_commands_for_all_folders_are_checked_before_the_first_runs(capsys: Capture) -> None:
    batch = Batch(("a", "b$none"), ("echo <CURRENT_VIMAP_FOLDER>", "echo --nothing"))
    assert run_batch(batch, make_runner, keep_going=False, discard=False) == Status.USER_ERROR
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("line 2, column 1: echo has no flag --nothing") == 2
    assert "map folder b$none: " in err


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("commands: [a]", "vi_map_folder_paths is missing"),
        ("vi_map_folder_paths: [a]", "commands is missing"),
        ("vi_map_folder_paths: a\ncommands: [a]", "not a list of strings"),
        ("vi_map_folder_paths: [a]\ncommands: [a]\nextra: 1", "unknown key 'extra'"),
        ("- a", "needs the keys"),
        ("a: [", "batch.yaml"),
    ],
)
def test_a_wrong_batch_file_names_the_key(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "batch.yaml"
    path.write_text(text)
    with pytest.raises(UserError, match=message) as error:
        read_batch(path)
    assert "\n" not in str(error.value)


def test_a_missing_script_names_the_file(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="nothing"):
        read_script(tmp_path / "nothing")


def test_program_arguments() -> None:
    found = parse_arguments(["-c", "a; b", "--json", "--flagfile=x", "--ba_n=3", "--keep_going"])
    assert (found.mode, found.text, found.json, found.keep_going) == (
        "commands",
        "a; b",
        True,
        True,
    )
    assert (found.flagfiles, found.flags) == ([Path("x")], ["--ba_n=3"])
    found = parse_arguments(["run", "a.maplab", "b.maplab", "--flagfile", "y", "--ba_n", "3"])
    assert (found.mode, found.files) == ("run", [Path("a.maplab"), Path("b.maplab")])
    assert (found.flagfiles, found.flags) == ([Path("y")], ["--ba_n", "3"])
    found = parse_arguments(["solve", "--ba_n", "3", "--json", "--help", "x"])
    assert (found.mode, found.words, found.json) == (
        "command",
        ["solve", "--ba_n", "3", "--help", "x"],
        True,
    )
    assert parse_arguments(["-c", "load a", "--json", "-c", "elq"]).text == "load a; elq"
    assert parse_arguments([]).mode == "prompt"
    assert parse_arguments(["--help"]).help
    assert parse_arguments(["--version"]).version


@pytest.mark.parametrize(
    "argv",
    [
        ["-c"],
        ["run"],
        ["batch"],
        ["--flagfile"],
        ["-c", "a", "b"],
        ["run", "a.maplab", "-c", "elq"],
    ],
)
def test_wrong_program_arguments(argv: list[str]) -> None:
    with pytest.raises(FlagError):
        parse_arguments(argv)


def test_durations() -> None:
    assert [format_seconds(s) for s in (0.123, 12.34, 125)] == ["0.12 s", "12.3 s", "2 min 05 s"]


@pytest.mark.parametrize("name", ["two words", "a;b", "it's", 'a "map"', "# no comment"])
def test_folders_are_taken_literally(tmp_path: Path, name: str) -> None:
    save_map(walk_map(), tmp_path / name)
    loaded = []

    def make_runner() -> Runner:
        runner = Runner(Session(), ConsoleTerminal())
        loaded.append(runner)
        return runner

    batch = Batch((str(tmp_path / name),), (f"load --map_folder={FOLDER_TEMPLATE}",))
    assert run_batch(batch, make_runner, keep_going=False, discard=False) == Status.OK
    assert [entry.folder for entry in loaded[-1].session.maps] == [tmp_path / name]
