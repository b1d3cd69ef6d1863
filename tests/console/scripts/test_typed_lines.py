"""What a line can be besides a command, and chains that are not started for a fault."""

import json
import re
import time
from pathlib import Path

import pytest

from maplab_py.console.commands.lines import typed_commands, variable_lookup
from maplab_py.console.commands.registry import load_registry
from maplab_py.console.prompt.loop import toolbar_text
from maplab_py.console.scripts.aliases import read_aliases
from maplab_py.console.scripts.checking import check_commands
from maplab_py.console.scripts.runner import Runner
from maplab_py.console.session.paths import user_aliases
from maplab_py.console.session.session import Session
from maplab_py.console.session.status import Status
from maplab_py.console.terminal import output
from maplab_py.console.terminal.output import ConsoleTerminal
from maplab_py.errors import FlagError, UserError
from maplab_py.report import Message
from maplab_py.storage.native import save_map
from tests.console.sample_plugin import make_registry, make_session, map_of

Capture = pytest.CaptureFixture[str]


@pytest.fixture
def runner(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Runner:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.chdir(tmp_path)
    terminal = ConsoleTerminal()
    return Runner(Session(make_registry(), terminal), terminal)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("echo $A", [["echo", "x y"]]),
        ("echo ${A}b", [["echo", "x yb"]]),
        ("echo \"$A\" '$A' \\$A", [["echo", "x y", "$A", "$A"]]),
        ("echo $ $$ $1.5", [["echo", "$", "$$", "one.5"]]),
    ],
)
def test_variables(text: str, words: list[list[str]]) -> None:
    lookup = variable_lookup({"A": "x y", "1": "one"})
    assert [command.words for command in typed_commands(text, lookup)] == words


def test_an_unset_variable_is_an_error() -> None:
    with pytest.raises(FlagError, match=r"\$NO_SUCH_THING is not set"):
        typed_commands("echo $NO_SUCH_THING", variable_lookup({}))
    assert typed_commands("echo $NO_SUCH_THING")[0].words == ["echo", "$NO_SUCH_THING"]


@pytest.mark.parametrize(
    ("text", "shells", "background"),
    [
        ("!ls; a", ["ls", ""], [False, False]),
        ("!sh -c 'ls; pwd'; a", ["sh -c 'ls; pwd'", ""], [False, False]),
        ('!ls a\\;b "c;\\";"; a', ['ls a\\;b "c;\\";"', ""], [False, False]),
        ("a | grep b; c", ["grep b", ""], [False, False]),
        ("a | grep 'x;y'\nb", ["grep 'x;y'", ""], [False, False]),
        ("a &; b", ["", ""], [True, False]),
        ("a & b", ["", ""], [True, False]),
        ("a 'b & c | d' &", [""], [True]),
        ("a --x=1|2 b&c !d", [""], [False]),
    ],
)
def test_operators(text: str, shells: list[str], background: list[bool]) -> None:
    commands = typed_commands(text)
    assert [command.shell for command in commands] == shells
    assert [command.in_background for command in commands] == background


@pytest.mark.parametrize("text", ["& a", "| a", "; | a"])
def test_an_operator_needs_a_command(text: str, runner: Runner) -> None:
    assert runner.run_text(text) == Status.USER_ERROR


def test_assignments_hold_for_the_following_commands(runner: Runner, capsys: Capture) -> None:
    assert runner.run_text("out='a b'; sub=$out/c; echo $sub; out=d\necho $out") == Status.OK
    assert capsys.readouterr().out == "a b/c\nd\n"
    assert runner.run_text("echo $nosuch_variable; echo b") == Status.USER_ERROR


def test_the_shell(runner: Runner, tmp_path: Path) -> None:
    assert runner.run_text(f"!echo hello > {tmp_path}/x; !echo more >> {tmp_path}/x") == Status.OK
    assert (tmp_path / "x").read_text() == "hello\nmore\n"
    assert runner.run_text("!exit 3") == Status.FAILED
    assert runner.run_text("!") == Status.USER_ERROR


def test_pipes(runner: Runner, tmp_path: Path, capsys: Capture) -> None:
    target = tmp_path / "found"
    assert runner.run_text(f"help | grep -c destroy > {target}") == Status.OK
    assert target.read_text() == "1\n"
    assert capsys.readouterr().out == ""
    assert runner.run_text("help | true") == Status.OK
    assert runner.run_text("nosuch | cat") == Status.USER_ERROR
    assert runner.run_text("echo on standard output again") == Status.OK
    assert "again" in capsys.readouterr().out


def test_aliases(runner: Runner, capsys: Capture) -> None:
    assert runner.run_text("alias greet='echo hello'; greet you; alias") == Status.OK
    out = capsys.readouterr().out
    assert "hello you\n" in out
    assert re.search(r"greet +echo hello", out)
    assert runner.run_text("alias both='greet a; echo'; both b") == Status.OK
    assert capsys.readouterr().out.endswith("hello a\nb\n")
    assert runner.run_text("unalias greet; greet") == Status.USER_ERROR
    assert runner.run_text("unalias greet") == Status.USER_ERROR


@pytest.mark.parametrize(
    "line",
    ["alias echo=list", "alias quit=list", "alias 'a b=list'", "alias x", "alias x=", "alias =y"],
)
def test_wrong_aliases(runner: Runner, line: str) -> None:
    assert runner.run_text(line) == Status.USER_ERROR
    assert runner.session.aliases == {}


@pytest.mark.parametrize("lines", ["alias a=b; alias b=a; a", "alias a='echo x; a'; a"])
def test_aliases_in_a_circle_end(runner: Runner, lines: str, capsys: Capture) -> None:
    assert runner.run_text(lines) == Status.USER_ERROR
    assert re.search("alias '[ab]' (refers to|contains) itself", capsys.readouterr().err)


def test_kept_aliases_outlive_the_session(runner: Runner) -> None:
    assert runner.run_text("alias t='echo x' --keep; alias u=echo") == Status.OK
    assert read_aliases(user_aliases()) == {"t": "echo x"}
    assert runner.run_text("unalias t") == Status.OK
    assert read_aliases(user_aliases()) == {}


def test_a_dry_run_leaves_the_map(runner: Runner, capsys: Capture) -> None:
    runner.session.maps.add("a", map_of(1))
    state = runner.session.maps.state
    assert runner.run_text("add_mission --dry_run") == Status.OK
    out, err = capsys.readouterr()
    assert "2 missions" in out
    assert "dry run: nothing has changed" in err
    assert runner.session.maps.state is state
    assert runner.session.run("add_mission", dry_run=True) == Message("2 missions")
    assert runner.session.maps.state is state
    assert runner.run_text("destroy --dry_run") == Status.OK
    assert runner.run_text("transcript x --dry_run") == Status.USER_ERROR
    assert not Path("x").exists()


def test_a_dry_run_tells_of_files_and_writes_none(runner: Runner, capsys: Capture) -> None:
    assert runner.run_text("keep_words w.txt ab cd --dry_run") == Status.OK
    out, err = capsys.readouterr()
    assert out == "kept\n"
    assert "would write w.txt (4 bytes)" in err
    assert not Path("w.txt").exists()
    assert runner.run_text("keep_words w.txt ab") == Status.OK
    assert Path("w.txt").read_text() == "ab"
    assert runner.run_text("keep_words w.txt x --dry_run") == Status.USER_ERROR
    assert "w.txt exists already" in capsys.readouterr().err
    assert runner.run_text("keep_words w.txt x --dry_run --overwrite & ; join") == Status.OK
    assert "would replace w.txt (1 bytes)" in capsys.readouterr().err
    assert Path("w.txt").read_text() == "ab"


def test_errors_are_objects_with_json(capsys: Capture) -> None:
    terminal = ConsoleTerminal(as_json=True)
    runner = Runner(Session(make_registry(), terminal), terminal)
    runner.run_text("nosuch; echo a; find_nothing", keep_going=True)
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [(line["schema"], line["status"]) for line in lines] == [(1, 2), (1, 0), (1, 1)]
    assert lines[0]["report"] is None
    assert "unknown command" in lines[0]["error"]
    assert lines[2]["error"] == "nothing was found"
    assert lines[1]["seconds"] >= 0.0


def test_the_toolbar_tells_what_is_selected(runner: Runner) -> None:
    session = runner.session
    assert toolbar_text(session) == ""
    session.maps.add("a", map_of(2))
    session.maps.add("b", map_of(1), select=False)
    session.marks["viewer"] = "http://localhost:8080"
    assert toolbar_text(session) == (
        "map a · 2 missions · 0 vertices · 0 landmarks · unsaved · 1 other map · "
        "viewer http://localhost:8080"
    )
    for columns in range(60, 130):
        assert toolbar_text(session, columns).endswith("viewer http://localhost:8080")
        assert len(toolbar_text(session, columns)) <= columns or columns < 64
    assert "0 vertices" in toolbar_text(session, 90)
    assert "landmarks" not in toolbar_text(session, 90)


def test_the_pager_gets_what_is_longer_than_the_screen(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    class Screen:
        def isatty(self) -> bool:
            return True

        def flush(self) -> None:
            pass

    assert not output.page("x\n" * 1000)
    monkeypatch.setattr("sys.stdin", Screen())
    monkeypatch.setattr("sys.stdout", Screen())
    monkeypatch.setenv("MAPLAB_PAGER", f"cat > {tmp_path}/paged")
    assert not output.page("x\n" * 3)
    assert output.page("x\n" * 1000)
    assert (tmp_path / "paged").read_text() == "x\n" * 1000
    monkeypatch.setenv("MAPLAB_PAGER", "cat")
    assert not output.page("x\n" * 1000)
    monkeypatch.delenv("MAPLAB_PAGER")
    assert output.pager_command() in ("less -FRXK", "")


def test_a_report_goes_to_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runner = Runner(make_session(), ConsoleTerminal())
    file = tmp_path / "out.txt"
    assert runner.run_text(f"echo a > {file}; echo b >> {file}; echo c >>{file}") == Status.OK
    text = file.read_text()
    assert [line.strip() for line in text.splitlines() if line.strip()] == ["a", "b", "c"]
    assert runner.run_text(f"echo d > {file}") == Status.OK
    assert "a" not in file.read_text()
    before = file.read_text()
    assert runner.run_text(f"nosuch > {file}") == Status.USER_ERROR
    assert file.read_text() == before
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("echo a >", "no file is named after '>'"),
        ("> out", "no command before '>'"),
        ("echo a > x > y", "one file only"),
        ("echo a > x &", "takes neither"),
        ("echo a > x | cat", "takes neither"),
        ("echo a > /no/such/folder/x", "name a file in a folder that exists"),
        ("echo a > /", "name a file"),
    ],
)
def test_wrong_redirections(
    line: str,
    message: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert Runner(make_session(), ConsoleTerminal()).run_text(line) == Status.USER_ERROR
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_the_only_required_flag_may_be_given_by_position() -> None:
    session = Session()
    call = session.parse(["rename_map", "office"])
    assert call.values["map_key"] == "office"
    assert session.parse(["evaluate_trajectory", "t.tum"]).values["ground_truth"] == Path("t.tum")
    assert session.parse(["localize", "query"]).values["localization_map"] == "query"
    for command in session.registry.commands:
        required = [flag.name for flag in command.flags.values() if flag.is_required]
        if len(required) == 1 and not command.variadic:
            assert command.positional[:1] == (required[0],), command.name


@pytest.mark.parametrize(
    "name",
    [
        "csv_export",
        "csv_export_vertices_only",
        "export_colmap",
        "export_mission_info",
        "export_ncamera_calibration",
        "generate_summary_map_and_save_to_disk",
        "import_colmap",
        "landmark_sparsify",
        "relax_external",
    ],
)
def test_a_flag_without_which_a_command_refuses_may_be_given_by_position(name: str) -> None:
    call = Session().parse([name, "9"])
    (flag,) = call.command.positional
    assert str(call.values[flag]) == "9"


@pytest.mark.parametrize(
    ("line", "flag"),
    [
        ("save -o x", "map_folder"),
        ("rovioli walk -o x", "save_map_folder"),
        ("rovioli walk -o=x", "save_map_folder"),
        ("export_g2o -o x", "file"),
        ("plot_trajectory -o x", "plot_file"),
        ("ettc -o x", "pose_export_file"),
        ("export_mcap -o x", "recording"),
        ("check_recording walk -o x", "apply"),
    ],
)
def test_one_letter_names_what_any_command_writes(line: str, flag: str) -> None:
    assert Session().parse(line.split()).values[flag] == Path("x")


def test_what_is_read_is_no_output() -> None:
    registry = load_registry()
    assert {"load", "push", "play_recording"} & {
        c.name for c in registry.commands if c.output
    } == set()
    assert all(c.output not in c.reads for c in registry.commands)
    with pytest.raises(FlagError, match="map_stats writes no file"):
        Session().parse(["map_stats", "-o", "x"])


REGISTRY = load_registry()


@pytest.fixture
def session() -> Session:
    return Session(REGISTRY)


FAULTS = {
    "optivi": "unknown command 'optivi'",
    "optvi --ba_num_iteration=3": "has no flag --ba_num_iteration",
    "optvi --ba_num_iterations=three": "wants a whole number",
    "evaluate_trajectory": "needs --ground_truth",
    "evaluate_trajectory --ground_truth=nosuch.csv": "there is no such file",
    "load nosuch": "there is no such file",
    "load $NO_SUCH_VARIABLE": "variable $NO_SUCH_VARIABLE is not set",
    "kfh word": "unexpected word 'word'",
    "optvi --flagfile=nosuch.flags": "nosuch.flags",
    "optvi --flagfile=wrong.flags": "wrong.flags:1: optimize_visual_inertial has no flag --nosuch",
    "set --nosuch=1": "no command has a flag --nosuch",
    "save_view wrong.flags/sub/map.png": "wrong.flags/sub/map.png: cannot be written",
    "save_view wrong.flags": "exists already: give --overwrite",
    "localize --localization_map=none": "there is no such map, neither in memory nor on disk",
}


@pytest.mark.parametrize("place", ["first", "middle", "last"])
@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_anywhere_is_named_and_nothing_runs(
    fault: str, place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    Path("wrong.flags").write_text("--nosuch=1")
    sound = ["create_new_map a", "map_stats"]
    sound.insert({"first": 0, "middle": 1, "last": 2}[place], fault)
    runner = Runner(Session(REGISTRY), ConsoleTerminal())
    began = time.process_time()
    assert runner.run_script("; ".join(sound)) == Status.USER_ERROR
    assert time.process_time() - began < 0.5
    assert not len(runner.session.maps)
    column = "; ".join(sound).index(fault) + 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: column {column}: ")
    assert FAULTS[fault] in line


def test_a_folder_without_permission_is_named(
    session: Session, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    def refuse(path: Path) -> bool:
        raise PermissionError(13, "Permission denied", str(path))

    for name in ("exists", "is_file", "is_dir"):
        monkeypatch.setattr(Path, name, refuse)
    text = "load locked/map; recording_info .; select_map none; save_view locked/map.png"
    assert Runner(session, ConsoleTerminal()).run_script(text) == Status.USER_ERROR
    assert "--map_folder=locked/map: Permission denied" in capsys.readouterr().err


def test_all_faults_of_a_script_are_named_with_their_lines(session: Session) -> None:
    text = "map_stats\n# a remark\n  optivi; kfh --x=1\nlc --lc_min_inlier_count=many"
    problems = check_commands(text, session)
    assert [problem.split(":")[0] for problem in problems] == [
        "line 3, column 3", "line 3, column 11", "line 4, column 1",
    ]  # fmt: skip


SOUND = [
    "N=3; optvi --ba_num_iterations=$N",
    "set --ground_truth=nosuch.csv; evaluate_trajectory",
    "alias tidy='elq; rbl'; tidy --help; tidy",
    "save results; load results; load results/sub",
    "!make maps; load maps/a",
    "q; nonsense",
    "optvi --ba_num_iterations=3 &",
    "map_stats > stats.txt; map_stats | grep good",
    "help lc; lc --help",
    "simulate --map_folder=sim; load sim/session_1",
    "visualize; why $pick",
    "create_new_map a; localize --localization_map=a; select_map a",
    "load_all --maps_folder=.; select_map sub_1; load_all sub.1; select_map core",
    "load link; select_map inner; import_g2o graph.g2o.gz; select_map graph",
    "import_trajectory graph.g2o.gz --as=mission; select_map graph",
    "demo; load maplab_demo",
    "watch --command='copy_map b' --repetitions=1; select_map b",
    "split_map; rename_map whole; load_all .; select_map whole_cell_1; recover; merge_map other",
    "save_view new/folder/map.png; save_view new/folder/map.png --overwrite",
]


@pytest.mark.parametrize("text", SOUND)
def test_what_earlier_commands_make_is_there(
    text: str, session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    if text.startswith("set"):
        (tmp_path / "nosuch.csv").touch()
    (tmp_path / "sub.1" / "inner" / "core").mkdir(parents=True)
    (tmp_path / "link").symlink_to("sub.1/inner")
    (tmp_path / "graph.g2o.gz").touch()
    assert check_commands(text, session) == []


def test_checking_leaves_the_session_as_it_is(session: Session) -> None:
    check_commands("X=1; alias tidy='elq'; set --ba_num_iterations=3", session)
    assert session.variables == {}
    assert session.aliases == {}
    assert session.settings.current() == {}


def test_an_alias_in_a_circle_is_a_fault(session: Session) -> None:
    (problem,) = check_commands("alias a='a b'; a", session)
    assert "contains itself" in problem or "refers to itself" in problem


def test_with_keep_going_sound_commands_run(capsys: pytest.CaptureFixture[str]) -> None:
    runner = Runner(Session(REGISTRY), ConsoleTerminal())
    assert runner.run_script("nonsense; create_new_map a", keep_going=True) == Status.USER_ERROR
    assert runner.session.maps.keys == ["a"]


def test_what_a_failed_script_made_is_recovered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    runner = Runner(Session(REGISTRY), ConsoleTerminal())
    runner.session.maps.add("a", map_of(1))
    made = runner.session.vi_map
    assert runner.finish(runner.run_script("restore nothing"), discard=False) == Status.USER_ERROR
    assert "maplab recover" in capsys.readouterr().err
    again = Session(REGISTRY)
    again.run("recover")
    assert again.maps.keys == ["a"]
    assert again.vi_map.missions.id.tolist() == made.missions.id.tolist()
    assert [entry.key for entry in again.maps.unsaved] == ["a"]
    for _ in range(7):
        assert runner.finish(discard=False) in (Status.OK, Status.USER_ERROR)
    assert len(list((tmp_path / "maplab" / "rescued").iterdir())) <= 5


def test_a_script_is_predicted_from_former_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, session: Session
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    for name, count in (("small", 1), ("large", 3)):
        save_map(map_of(count), tmp_path / name)
    (tmp_path / "large" / "resources").mkdir()
    (tmp_path / "large" / "resources" / "images").write_bytes(bytes(1_000_000))
    text = "load small; map_stats; save copies"
    Path("s.maplab").write_text(text)
    plan = session.check("s.maplab")
    assert [step.runs for step in plan.steps] == [0, 0, 0]
    assert (plan.total_s, plan.not_predicted) == (0.0, 3)
    assert Runner(Session(REGISTRY), ConsoleTerminal()).run_script(text) == Status.OK
    plan = session.check("s.maplab")
    assert [(step.step, step.command, step.runs) for step in plan.steps] == [
        (1, "load small", 1), (2, "map_stats", 1), (3, "save copies", 1)
    ]  # fmt: skip
    assert plan.total_s > 0.0
    assert plan.steps[2].disk_mb > 0.0
    Path("s.maplab").write_text(text.replace("small", "large"))
    larger = session.check("s.maplab")
    assert larger.total_s > plan.total_s
    (tmp_path / "maplab" / "costs.json").write_text("[1")
    assert session.check("s.maplab").not_predicted == 3
    Path("s.maplab").write_text("lod x; map_stats --y")
    with pytest.raises(UserError, match=r"column 1: unknown command.*column 8: map_stats has no"):
        session.check("s.maplab")
