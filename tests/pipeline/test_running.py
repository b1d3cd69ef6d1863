"""Plans of stages, and batches that run, fail and are resumed."""

import json
import shutil
from pathlib import Path

import pytest

from maplab_py.console.scripts.batch import read_batch
from maplab_py.errors import FlagError, UserError
from maplab_py.pipeline import (
    Pipeline,
    PipelineOptions,
    PipelineReport,
    Stage,
    Watcher,
    run_pipeline,
)
from maplab_py.pipeline.plan import in_place, ordered
from maplab_py.pipeline.records import names_of
from maplab_py.storage.native import load_map, save_map
from tests.pipeline.support import LOAD, MERGED, contents, pipeline, sessions, small_maps, starts
from tests.vimap.builders import walk_map

SAVE = "save --map_folder=<RESULT_FOLDER>"


def stage(name: str, each: str = "", *all_of: str, commands: tuple[str, ...] = (SAVE,)) -> Stage:
    return Stage(name, commands, each, all_of)


def test_stages_follow_what_they_need() -> None:
    stages = (stage("c", "", "b", "a"), stage("b", "a"), stage("a", "maps"))
    assert [s.name for s in ordered(Pipeline("f", (), stages))] == ["a", "b", "c"]


@pytest.mark.parametrize(
    ("stages", "message"),
    [
        ((), "has no stages"),
        ((stage("a", "b"), stage("b", "", "a")), "run in a circle: a needs b needs a"),
        ((stage("a", "a"),), "in a circle: a needs a"),
        ((stage("a", "maps"), stage("a", "maps")), "two stages have the name a"),
        ((stage("a", "x"),), "needs a stage x, which does not exist"),
        ((stage("a"),), "needs one of 'each' and 'all'"),
        ((stage("a", "maps", "maps"),), "needs one of 'each' and 'all'"),
        ((stage("maps", "maps"),), "'maps' cannot be the name"),
        ((stage("../x", "maps"),), "cannot be the name of a stage"),
        ((stage("a", "maps", commands=()),), "has no commands"),
        ((stage("a", "maps", commands=("optvi",)),), "no command writes to <RESULT_FOLDER>"),
        ((Stage("a", (SAVE,), "maps", memory_gb=-1.0),), "memory_gb=-1 is negative"),
    ],
)
def test_wrong_plans_are_refused(stages: tuple[Stage, ...], message: str) -> None:
    with pytest.raises(UserError) as error:
        ordered(Pipeline("city.yaml", (), stages))
    assert message in str(error.value)
    assert str(error.value).startswith("city.yaml: ")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("stages: 3", "stages is not a list"),
        ("stages: [3]", "stage 1 has no name"),
        ("stages: [{name: a, each: maps, after: b}]", "unknown key 'after'"),
        ("stages: [{name: a, each: [maps]}]", "'each' is not the name of one stage"),
        ("stages: [{name: a, all: [3]}]", "all is not a list of strings"),
        ("stages: [{name: a, commands: {}}]", "commands is not a list of strings"),
        ("stages: [{name: a, memory_gb: much}]", "memory_gb is not a number"),
        ("stages: [{name: a}]\ncommands: [list]", "commands or stages, not both"),
    ],
)
def test_wrong_files_are_refused(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "p.yaml"
    file.write_text(f"vi_map_folder_paths: [x]\n{text}\n")
    with pytest.raises(UserError, match=message):
        read_batch(file)


def test_a_file_with_stages(tmp_path: Path) -> None:
    file = tmp_path / "p.yaml"
    file.write_text(
        "vi_map_folder_paths: [x]\n"
        "stages:\n"
        "  - {name: a, each: maps, commands: [kfh]}\n"
        "  - {name: b, all: [a, maps], memory_gb: 2, commands: [list, lc]}\n"
    )
    assert read_batch(file).stages == (
        Stage("a", ("kfh",), "maps"),
        Stage("b", ("list", "lc"), "", ("a", "maps"), 2.0),
    )


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"scheduler": "locl:2"}, "wants none, local:N or tcp"),
        ({"scheduler": "local:0"}, "wants none, local:N or tcp"),
        ({"scheduler": "local:x"}, "wants none, local:N or tcp"),
        ({"scheduler": "tcp:"}, "wants none, local:N or tcp"),
        ({"retries": -1}, "--retries=-1: must be at least 0"),
        ({"task_memory_gb": -0.5}, "must be at least 0"),
        ({"resume": True, "restart": True}, "contradict each other"),
        ({"redo_changed": True}, "--redo_changed needs --resume"),
    ],
)
def test_wrong_options_are_refused(values: dict[str, object], message: str) -> None:
    with pytest.raises(FlagError, match=message):
        PipelineOptions(**values)  # type: ignore[arg-type]


def test_names_take_as_many_parents_as_they_need() -> None:
    assert names_of([Path("/d/a"), Path("/d/b")]) == ["a", "b"]
    assert names_of([Path("/d/1/a"), Path("/d/2/a")]) == ["1-a", "2-a"]
    with pytest.raises(UserError, match="given twice"):
        names_of([Path("/d/a"), Path("/d/a")])


RESUME = PipelineOptions(resume=True)


def counts(report: PipelineReport) -> dict[str, tuple[int, int, int, int]]:
    return {s.stage: (s.done, s.kept, s.failed, s.not_run) for s in report.stages}


def test_a_fan_in_and_what_resuming_keeps(tmp_path: Path) -> None:
    maps = small_maps(tmp_path / "it's $maps", 2)
    plan = pipeline(maps, MERGED, sessions())
    results = tmp_path / "results"
    report = run_pipeline(plan, results)
    assert report.failure == ""
    assert counts(report) == {"sessions": (2, 0, 0, 0), "merged": (1, 0, 0, 0)}
    assert len(load_map(results / "merged" / "merged")[0].missions) == 2
    lines = (results / "tasks" / "merged" / "merged.jsonl").read_text().splitlines()
    assert [json.loads(line)["command"] for line in lines] == ["load_merge_map"] * 2 + ["save"]
    before = contents(results)

    with pytest.raises(UserError, match="results of an earlier run; give --resume"):
        run_pipeline(plan, results)
    report = run_pipeline(plan, results, RESUME)
    assert counts(report) == {"sessions": (0, 2, 0, 0), "merged": (0, 1, 0, 0)}

    # a result that is gone and an input that has changed are made again, the rest is kept
    shutil.rmtree(results / "sessions" / "m0")
    report = run_pipeline(plan, results, RESUME)
    assert counts(report) == {"sessions": (1, 1, 0, 0), "merged": (0, 1, 0, 0)}
    assert contents(results) == before
    save_map(walk_map(seed=7), maps[0], overwrite=True)
    report = run_pipeline(plan, results, RESUME)
    assert counts(report) == {"sessions": (1, 1, 0, 0), "merged": (1, 0, 0, 0)}


def test_changed_flags_and_commands_are_refused_when_resuming(tmp_path: Path) -> None:
    maps = small_maps(tmp_path, 1)
    results = tmp_path / "results"
    run_pipeline(pipeline(maps, sessions()), results, flags={"ba_num_iterations": "3"})
    before = contents(results)
    for stage, flags, message in (
        (sessions(), {"ba_num_iterations": "5"}, "--ba_num_iterations was 3 and is 5 now"),
        (sessions(), {}, "--ba_num_iterations was 3 and is not given now"),
        (sessions("list"), {"ba_num_iterations": "3"}, "'save .*' is 'list' now"),
    ):
        with pytest.raises(UserError, match=f"sessions/m0: {message}.*--redo_changed"):
            run_pipeline(pipeline(maps, stage), results, RESUME, flags=flags)
    assert contents(results) == before
    options = PipelineOptions(resume=True, redo_changed=True)
    report = run_pipeline(pipeline(maps, sessions("list")), results, options)
    assert counts(report) == {"sessions": (1, 0, 0, 0)}
    record = results / "tasks" / "sessions" / "m0.json"
    record.write_text("{")
    with pytest.raises(UserError, match=r"m0\.json: is damaged; delete it"):
        run_pipeline(pipeline(maps, sessions()), results, RESUME)


def test_a_failure_stops_what_needs_it_and_is_tried_again(tmp_path: Path) -> None:
    maps = small_maps(tmp_path, 2)
    plan = pipeline(maps, sessions("!test $PWD = m || exit 3"), MERGED)
    lines: list[str] = []
    options = PipelineOptions(retries=1)
    report = run_pipeline(
        plan, tmp_path / "r", options, keep_going=True, watcher=Watcher(line=lines.append)
    )
    assert counts(report) == {"sessions": (0, 0, 2, 0), "merged": (0, 0, 0, 1)}
    assert report.failure.startswith("2 of 2 tasks failed: sessions/m0: !test")
    assert starts(tmp_path / "r") == ["sessions/m0"] * 2 + ["sessions/m1"] * 2
    assert not (tmp_path / "r" / "sessions").exists()
    assert any("is tried again" in line for line in lines)

    # wrong usage is not tried again, and nothing else is started after it
    report = run_pipeline(pipeline(maps, sessions("nosuch")), tmp_path / "q", options)
    assert counts(report) == {"sessions": (0, 0, 1, 1)}
    assert starts(tmp_path / "q") == ["sessions/m0"]
    assert "nosuch" in report.failure


def test_a_task_over_its_memory_runs_once_more_alone(tmp_path: Path) -> None:
    maps = small_maps(tmp_path, 1)
    options = PipelineOptions(task_memory_gb=0.001, retries=3)
    report = run_pipeline(pipeline(maps, sessions("!sleep 1")), tmp_path / "r", options)
    assert starts(tmp_path / "r") == ["sessions/m0"] * 2
    assert "takes more than 0.00 GB of memory (--task_memory_gb)" in report.failure


def test_a_batch_file_without_stages_edits_maps_where_they_are(tmp_path: Path) -> None:
    maps = small_maps(tmp_path / "maps", 2)
    plan = in_place("b.yaml", maps, (LOAD, "remove_mission --map_mission=", "save"))
    report = run_pipeline(plan, tmp_path / "r", keep_going=True)
    assert counts(report)["batch"][2] == 2  # a wrong mission
    plan = in_place("b.yaml", maps, (LOAD, "remove_bad_landmarks", "save --overwrite"))
    report = run_pipeline(plan, tmp_path / "r")
    assert report.failure == ""
    report = run_pipeline(plan, tmp_path / "r", RESUME)
    assert counts(report) == {"batch": (0, 2, 0, 0)}
    save_map(walk_map(seed=5), maps[1], overwrite=True)
    report = run_pipeline(plan, tmp_path / "r", RESUME)
    assert counts(report) == {"batch": (1, 1, 0, 0)}


def test_a_task_that_writes_nothing_fails(tmp_path: Path) -> None:
    maps = small_maps(tmp_path, 1)
    plan = Pipeline("p", maps, (sessions(),))
    silent = pipeline(maps, type(plan.stages[0])("s", ("!true <RESULT_FOLDER>",), each="maps"))
    report = run_pipeline(silent, tmp_path / "r", PipelineOptions(retries=0))
    assert "have written nothing" in report.failure
