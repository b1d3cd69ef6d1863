"""Plans: order of stages, and one line for everything that is wrong with them."""

from __future__ import annotations

from pathlib import Path

import pytest

from maplab_py.console.scripts.batch import read_batch
from maplab_py.errors import FlagError, UserError
from maplab_py.pipeline import Pipeline, PipelineOptions, Stage
from maplab_py.pipeline.plan import ordered
from maplab_py.pipeline.records import names_of

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
