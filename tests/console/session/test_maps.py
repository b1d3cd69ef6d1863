"""Maps in memory as values: their history, and results of commands that ran at the same time."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from maplab_py.console.session.call import Call
from maplab_py.console.session.jobs import Job
from maplab_py.console.session.maps import MAX_UNDO, MapEntry, MapManager, MapsState, merge_states
from maplab_py.console.session.session import Session
from maplab_py.errors import UserError
from maplab_py.vimap import VIMap
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
