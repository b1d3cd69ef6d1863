"""Maps of a session: names, history and its memory, provenance."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from maplab_py.console.scripts.runner import Runner
from maplab_py.console.session.call import Call
from maplab_py.console.session.jobs import Job
from maplab_py.console.session.maps import (
    MAX_UNDO,
    MapEntry,
    MapManager,
    MapsState,
    UndoOptions,
    merge_states,
)
from maplab_py.console.session.session import Session
from maplab_py.console.session.status import Status
from maplab_py.console.terminal.output import ConsoleTerminal
from maplab_py.errors import FlagError, UserError
from maplab_py.storage.native import load_map, save_map
from maplab_py.vimap import VIMap
from maplab_py.vimap.comparison import is_same
from maplab_py.vimap.memory_use import SharedColumns, forget_lookups
from tests.console.sample_plugin import map_of
from tests.support.scene import Scene
from tests.vimap.builders import walk_map


def turned(vi_map: VIMap, step: float) -> VIMap:
    vertices = vi_map.vertices
    return vi_map.replace(vertices=vertices.replace(gyro_bias=vertices.gyro_bias + step))


def test_the_history_keeps_the_latest_steps_only() -> None:
    entry = MapEntry("a", walk_map())
    for number in range(MAX_UNDO + 5):
        entry = entry.with_value(turned(entry.vi_map, 1.0), f"command {number}")
    assert [step.command for step in entry.past] == [f"command {n}" for n in range(5, MAX_UNDO + 5)]
    for _ in range(MAX_UNDO):
        entry = entry.undone()
    np.testing.assert_allclose(entry.vi_map.vertices.gyro_bias, walk_map().vertices.gyro_bias + 5.0)
    with pytest.raises(UserError, match="nothing to undo"):
        entry.undone()


def test_a_new_command_ends_what_could_be_redone() -> None:
    first = MapEntry("a", walk_map())
    second = first.with_value(turned(first.vi_map, 1.0), "one")
    back = second.undone()
    assert back.redone().vi_map is second.vi_map
    other = back.with_value(turned(first.vi_map, 2.0), "two")
    with pytest.raises(UserError, match="nothing to redo"):
        other.redone()


def test_of_two_changes_of_one_map_the_later_is_kept_beside_it_and_is_unsaved() -> None:
    on_disk = walk_map()
    base = MapsState({"a": MapEntry("a", on_disk, Path("/maps/a"), on_disk)}, "a")
    # the later command has saved what it made; the other map of this name is what the folder holds
    saved = turned(on_disk, 1.0)
    entry = dataclasses.replace(base.entries["a"].with_value(saved, "job"), saved=saved)
    current = MapsState({"a": base.entries["a"].with_value(turned(on_disk, 2.0), "typed")}, "a")
    state, conflicts = merge_states(base, MapsState({"a": entry}, "a"), current)
    assert [(one.key, one.kept_as) for one in conflicts] == [("a", "a-1")]
    assert state.entries["a"] is current.entries["a"]
    kept = state.entries["a-1"]
    assert kept.vi_map is saved
    assert (kept.key, kept.folder, kept.is_saved) == ("a-1", None, False)
    assert [one.key for one in MapManager(state).unsaved] == ["a", "a-1"]


def test_a_cancelled_job_has_no_effect_even_when_its_result_comes_late() -> None:
    base = MapsState({"a": MapEntry("a", walk_map())}, "a")
    result = MapsState({"a": base.entries["a"].with_value(turned(walk_map(), 1.0), "job")}, "a")
    command = next(iter(Session().registry.commands))
    for is_cancelled in (True, False):
        maps = MapManager(base)
        job = Job(1, "job", Call(command, {}), base, result=result)
        if is_cancelled:
            job.cancel()
        job.apply(maps)
        assert maps.state is (base if is_cancelled else result)


def test_a_trial_leaves_the_maps_as_they_are() -> None:
    session = Session()
    before = session.maps.state
    session.run("create_new_map", "a", dry_run=True)
    assert session.maps.state is before
    session.run("create_new_map", "a")
    assert session.maps.keys == ["a"]


def changed(vi_map: VIMap, table: str, column: str) -> VIMap:
    """Return the map with one column replaced by another of the same size."""
    rows = getattr(vi_map, table)
    return vi_map.replace(**{table: rows.replace(**{column: getattr(rows, column) + 1.0})})


@pytest.fixture
def session() -> Session:
    session = Session()
    session.maps.add("map", Scene(vertices=20, landmarks=200).make())
    return session


def test_shared_columns_count_once() -> None:
    vi_map = Scene(vertices=5, landmarks=30).make()
    columns = SharedColumns()
    whole = columns.add(vi_map)
    assert whole == vi_map.nbytes()
    assert columns.add(vi_map.replace()) == 0
    other = changed(vi_map, "vertices", "v_M")
    assert columns.add(other) == vi_map.vertices.v_M.nbytes


def test_lookups_are_forgotten_and_made_again() -> None:
    vi_map = Scene(vertices=5, landmarks=30).make()
    before = vi_map.T_G_I
    forget_lookups(vi_map)
    assert "T_G_I" not in vars(vi_map)
    assert np.array_equal(vi_map.T_G_I, before)


def commit(session: Session, count: int) -> None:
    """Change all keypoints of the map a number of times, as commands do."""
    from maplab_py.console.session.context import CommandContext

    for _ in range(count):
        context = CommandContext(session, session.terminal.progress, session.terminal, "change")  # type: ignore[arg-type]
        context.commit(changed(context.vi_map, "keypoints", "uv_px"))
        context.apply_drafts()


def test_the_oldest_values_are_dropped(session: Session) -> None:
    size = session.vi_map.keypoints.uv_px.nbytes
    session.set_flags([f"--undo_max_gb={2.5e-9 * size}"])
    commit(session, 5)
    entry = session.maps.selected
    assert len(entry.past) == 2
    assert entry.dropped_values == 3
    for _ in range(2):
        session.run("undo")
    with pytest.raises(UserError, match=r"nothing to undo any more: 3 .* beyond --undo_max_gb"):
        session.run("undo")
    session.run("redo")
    assert len(session.maps.selected.past) == 1


def test_memory_says_what_is_kept_and_bounds_it(session: Session) -> None:
    size = session.vi_map.keypoints.uv_px.nbytes
    commit(session, 3)
    session.run("snapshot", "now")
    report = session.run("memory").as_dict()
    (line,) = report["maps"]
    assert line["undo_values"] == 4
    assert line["undo_gb"] == pytest.approx(3e-9 * size)
    assert line["columns_gb"] == pytest.approx(1e-9 * session.vi_map.nbytes())
    assert line["mapped_gb"] == 0.0
    assert report["undo_max_gb"] == UndoOptions().undo_max_gb
    assert report["process_gb"] > 0.0
    session.run("memory", undo_max_gb=0.0, dry_run=True)
    assert len(session.maps.selected.past) == 3
    session.run("memory", undo_max_gb=0.0)
    assert session.maps.selected.past == ()
    assert session.run("memory").as_dict()["maps"][0]["dropped_values"] == 3
    commit(session, 2)
    assert session.maps.selected.past == ()


def test_a_bound_below_zero_is_refused(session: Session) -> None:
    with pytest.raises(FlagError, match="--undo_max_gb=-1: must be at least 0"):
        session.run("memory", undo_max_gb=-1.0)


def test_merging_maps_one_by_one_keeps_to_the_bound(tmp_path: Path) -> None:
    folders = [tmp_path / f"map_{number}" for number in range(6)]
    for number, folder in enumerate(folders):
        save_map(walk_map(seed=number, first_ns=10**9 * (1 + 100 * number)), folder)
    bound_gb = 2.5e-9 * load_map(folders[0])[0].nbytes()
    session = Session()
    session.set_flags([f"--undo_max_gb={bound_gb}"])
    session.run("load", map_folder=folders[0])
    for count, folder in enumerate(folders[1:], start=2):
        session.run("load_merge_map", map_folder=folder)
        (line,) = session.run("memory").as_dict()["maps"]
        assert line["undo_gb"] <= bound_gb
        assert line["undo_values"] + line["dropped_values"] == count - 1
    assert line["dropped_values"] > 0
    assert len(session.vi_map.missions) == len(folders)


@pytest.fixture
def saved_walks(tmp_path: Path) -> Session:
    for number in range(3):
        save_map(walk_map(seed=number), tmp_path / f"walk {number}")
    return Session()


def run(saved_walks: Session, *lines: str) -> None:
    runner = Runner(saved_walks, ConsoleTerminal())
    assert runner.run_text("\n".join(lines)) == Status.OK


def script_of(saved_walks: Session) -> list[str]:
    return list(saved_walks.run("history", as_script=True).as_dict()["commands"])


def test_the_script_makes_the_same_map_in_a_new_session(
    saved_walks: Session, tmp_path: Path
) -> None:
    run(
        saved_walks,
        f"load '{tmp_path}/walk 0' --map_key=first",
        "elq --elq_min_observers=50",
        f"load '{tmp_path}/walk 1' --map_key=second",
        "set elq_min_observers=60",
        "elq",
        "set_all_mission_baseframes_to_known",
        "undo",
        "select_map first",
        "sbk",
        "merge_map second",
        "rename_mission monday --map_mission=walk\\ 0",
        "snapshot merged",
        "remove_mission --map_mission=monday --yes",
        "restore merged",
    )
    script = script_of(saved_walks)
    again = Session()
    run(again, *script)
    assert is_same(again.vi_map, saved_walks.vi_map)
    assert not any(line.startswith(("undo", "restore", "remove_mission")) for line in script)
    assert "select_map first" in script
    assert sum("--elq_min_observers=60" in line for line in script) == 1


def test_undone_commands_are_shown_but_not_written(saved_walks: Session, tmp_path: Path) -> None:
    run(saved_walks, f"load '{tmp_path}/walk 0'", "sbk", "rename_mission monday", "undo")
    assert [line.split()[0] for line in script_of(saved_walks)] == [
        "load",
        "set_mission_baseframe_to_known",
    ]
    shown = saved_walks.run("history").as_dict()["commands"]
    assert [line["state"] for line in shown] == ["", "", "undone"]
    run(saved_walks, "redo")
    assert script_of(saved_walks)[-1] == "rename_mission --name=monday"


def test_a_renamed_map_and_a_dry_run(saved_walks: Session, tmp_path: Path) -> None:
    run(saved_walks, f"load '{tmp_path}/walk 0'", "rename_map office", "sbk --dry_run", "sbk")
    script = script_of(saved_walks)
    again = Session()
    run(again, *script)
    assert is_same(again.vi_map, saved_walks.vi_map)
    assert [line.split()[0] for line in script] == [
        "load",
        "rename_map",
        "set_mission_baseframe_to_known",
    ]


def test_a_map_from_python_has_no_script(saved_walks: Session) -> None:
    saved_walks.maps.add("a", map_of(1))
    with pytest.raises(UserError, match="made from Python"):
        saved_walks.run("history")
