"""Advice, remedies that `fix` and `--auto_fix` run, and help."""

import ast
import dataclasses
from collections.abc import Iterator
from pathlib import Path

import maplab_plugins
import numpy as np
import pytest
from maplab_plugins.console.help import TASKS

import maplab_py
from maplab_py.algorithms.anchoring.options import AnchoringReport
from maplab_py.algorithms.landmarks.options import LandmarkQualityReport
from maplab_py.algorithms.loop_closure.reports import LoopClosureReport, Verdict
from maplab_py.console.commands.registry import Plugin, Registry, load_registry
from maplab_py.console.scripts.runner import Runner
from maplab_py.console.session.session import Session
from maplab_py.console.session.status import Status
from maplab_py.console.terminal.output import ConsoleTerminal
from maplab_py.errors import UserError
from maplab_py.interop.resources.images import import_images
from maplab_py.plugin import CommandContext, Report, command
from maplab_py.vimap import LandmarkQuality, VIMap
from tests.algorithms.map_update.test_update import sessions as small_rooms
from tests.console.sample_plugin import make_session
from tests.plugins.test_loopclosure import TWICE, session_of
from tests.support.stereo_room import StereoRoom, quarter_size


class Advised(Report):
    value: int = 1

    @property
    def advice(self) -> str:
        return "go on"


@command("advised", needs_map=False)
def advised(context: CommandContext) -> Advised:
    """Give advice."""
    return Advised()


@pytest.mark.parametrize(
    ("is_prompt", "line", "is_shown"),
    [
        (True, "advised", True),
        (False, "advised", False),
        (True, "set advice=false; advised", False),
        (True, "set advice=false; unset advice; advised", True),
    ],
)
def test_advice_is_shown_at_the_prompt_unless_it_is_disabled(
    is_prompt: bool, line: str, is_shown: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    terminal = ConsoleTerminal()
    terminal.is_prompt = is_prompt
    runner = Runner(make_session(), terminal)
    runner.session.registry.add(advised.maplab_command, Plugin("p"))  # type: ignore[attr-defined]
    assert runner.run_text(line) == Status.OK
    assert ("next: go on" in capsys.readouterr().out) == is_shown


QUALITY = LandmarkQualityReport(100, 6, 94, 0, 50, 50, 0, too_few_observers=90, too_far=10)


@pytest.mark.parametrize(
    ("report", "part"),
    [
        (QUALITY, "94 % of the landmarks are bad, 90 of them for too few observers"),
        (QUALITY, "--elq_min_observers"),
        (dataclasses.replace(QUALITY, good=60, bad=40), ""),
        (LoopClosureReport(candidates=9, refused={Verdict.IMPLAUSIBLE.value: 9}), "relax first"),
        (LoopClosureReport(candidates=9), "lc_report --which=refused"),
        (LoopClosureReport(candidates=9, accepted=9), ""),
        (LoopClosureReport(candidates=9, accepted=9, landmarks_merged=4), "optvi"),
        (AnchoringReport((), (), {"61dc0de3": "reason"}, ()), "see `why 61dc0de3`"),
        (AnchoringReport((), ("61dc0de3",), {}, ()), ""),
    ],
)
def test_reports_advise_where_it_is_earned(report: Report, part: str) -> None:
    assert part in report.advice
    assert bool(part) == bool(report.advice)


CLOSE = "lc --lc_max_merge_gap_m=0.2"


def runner_of(session: Session) -> Runner:
    return Runner(session, ConsoleTerminal())


@pytest.fixture
def drifted() -> Runner:
    """A session walked twice, whose closures correct more than landmarks may be moved."""
    return runner_of(session_of(TWICE))


def test_fix_runs_the_remedy_and_the_refused_command(
    drifted: Runner, capsys: pytest.CaptureFixture[str]
) -> None:
    assert drifted.run_text(CLOSE) == Status.FAILED
    assert "run relax first" in capsys.readouterr().err
    assert drifted.run_text("map_stats; fix") == Status.OK
    assert int(drifted.session.run("lc").landmarks_merged) == 0  # all is merged
    assert drifted.run_text("fix") == Status.USER_ERROR
    assert "no command was refused" in capsys.readouterr().err


def test_scripts_mend_themselves_only_when_asked(drifted: Runner) -> None:
    assert drifted.run_script(f"{CLOSE}; map_stats") == Status.FAILED
    drifted.run_text("undo")
    drifted.session.set_flags(["--auto_fix"])
    assert drifted.run_script(f"{CLOSE}; map_stats") == Status.OK


def test_bad_landmarks_are_judged_again() -> None:
    session = session_of(TWICE)
    vi_map = session.vi_map
    bad = np.full(len(vi_map.landmarks), LandmarkQuality.BAD, dtype=vi_map.landmarks.quality.dtype)
    landmarks = dataclasses.replace(vi_map.landmarks, quality=bad)
    judged = dataclasses.replace(vi_map, landmarks=landmarks)
    session.maps.update(session.maps.selected.with_value(judged, "elq"))
    session.set_flags(["--auto_fix"])
    assert runner_of(session).run_text("landmark_sparsify --num_landmarks_to_keep=50") == Status.OK
    assert (session.vi_map.landmarks.quality == LandmarkQuality.GOOD).sum() == 50


def test_a_refusal_without_a_remedy_is_not_repeated(
    drifted: Runner, capsys: pytest.CaptureFixture[str]
) -> None:
    drifted.session.set_flags(["--auto_fix"])
    assert drifted.run_text("landmark_sparsify") == Status.USER_ERROR
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.fixture(scope="module")
def with_images(tmp_path_factory: pytest.TempPathFactory) -> VIMap:
    room = StereoRoom.simulated(tmp_path_factory.mktemp("room"), quarter_size(frame_rate_hz=2.0))
    return import_images(room.true_map, 0, room.recording)[0]


def _with_bad_landmarks(vi_map: VIMap) -> VIMap:
    bad = np.full_like(vi_map.landmarks.quality, LandmarkQuality.BAD)
    return vi_map.replace(landmarks=vi_map.landmarks.replace(quality=bad))


REFUSED = {
    "convert_all_depth_maps_to_point_clouds": "stereo_dense_reconstruction",
    "create_mesh_from_tsdf_grid -o room.ply": "create_tsdf_from_depth_resource",  # needs the former
    "generate_summary_map_and_save_to_disk -o summary": "retriangulate_landmarks",
    "landmark_sparsify --num_landmarks_to_keep=50": "retriangulate_landmarks",
    "tsdf --update": "create_tsdf_from_depth_resource",
    "visualize_esdf --viewer_port=0": "create_esdf_from_depth_resource",
    "asvv --lc_switch_variable_value=0.5": "lc --lc_insert_lc_edge_instead_of_merging",
    "visualize_loop_closures --viewer_port=0": "loopclosure_all_missions",
    "update_map --session=second": "set_mission_baseframe_to_known",
}
"""Lines that are refused, with their remedies."""
IN_A_WALK = ("asvv", "visualize_loop_closures")
"""Commands that need places which are visited twice."""


@pytest.mark.parametrize("line", REFUSED)
def test_refused_commands_run_after_their_remedies(
    line: str, with_images: VIMap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    is_walk = line.startswith(IN_A_WALK)
    with session_of(TWICE) if is_walk else Session() as session:
        if line.startswith("update_map"):
            first, second, _ = small_rooms().maps
            session.maps.add("second", second)
            session.maps.add("first", first)
        elif not is_walk:
            session.maps.add("room", _with_bad_landmarks(with_images))
        runner = runner_of(session)
        assert runner.run_text(line) != Status.OK
        assert session.refusal is not None
        assert runner.run_text("fix") == Status.OK
        assert session.refusal is None


def remedies() -> Iterator[str]:
    """Yield the remedies of all errors in the sources."""
    for package in (maplab_py, maplab_plugins):
        for path in Path(str(package.__file__)).parent.rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.keyword) and node.arg == "remedy":
                    value = node.value
                    if isinstance(value, ast.Constant) and isinstance(value.value, str):
                        yield value.value


def test_remedies_of_errors_are_commands_that_need_no_more() -> None:
    session = Session()
    names = session.registry.names
    lines = {line for line in remedies() if line.partition(" ")[0] in names}
    assert lines <= set(REFUSED.values())
    for line in lines:
        session.parse(line.split()).arguments()


@pytest.fixture(scope="module")
def session() -> Session:
    return Session(load_registry(), ConsoleTerminal())


@pytest.mark.parametrize(
    ("words", "first"),
    [
        (("ground", "truth"), "evaluate_localization"),
        (("wheel",), "import_wheel_odometry"),
        (("TUM",), "export_trajectory_to_csv"),  # one of its formats
        (("rpg",), "export_trajectory_to_csv"),  # a choice of a flag
        (("covariance",), "assign_edge_uncertainties"),
    ],
)
def test_words_find_commands(session: Session, words: tuple[str, ...], first: str) -> None:
    assert session.help(*words).commands[0].command == first


def test_the_beginning_of_a_word_counts_but_no_part_in_it(session: Session) -> None:
    names = [line.command for line in session.help("tum").commands]
    assert "visualize_mesh" not in names  # its flags say frustum


def test_a_command_has_its_page_and_one_that_is_misspelt_a_proposal(session: Session) -> None:
    assert session.help("optvi").command == "optimize_visual_inertial"
    with pytest.raises(UserError, match="did you mean optvi"):
        session.help("optvii")
    with pytest.raises(UserError, match="no command has to do with 'zzz qqq'"):
        session.help("zzz", "qqq")


def test_every_command_of_the_tasks_exists(session: Session) -> None:
    registry: Registry = session.registry
    names = [name for task in TASKS for name in task.commands.split(", ")]
    assert [name for name in names if not registry.knows(name)] == []
    assert session.help().tasks == TASKS
