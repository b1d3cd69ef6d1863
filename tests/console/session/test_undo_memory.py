"""Former values of maps keep to their bound, and `memory` says what they take."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from maplab_py.console.commands.registry import load_registry
from maplab_py.console.session.session import Session
from maplab_py.console.session.undo import UndoOptions
from maplab_py.errors import FlagError, UserError
from maplab_py.storage.native import load_map, save_map
from maplab_py.vimap import VIMap
from maplab_py.vimap.memory_use import SharedColumns, forget_lookups
from tests.support.scene import Scene
from tests.vimap.builders import walk_map


def changed(vi_map: VIMap, table: str, column: str) -> VIMap:
    """Return the map with one column replaced by another of the same size."""
    rows = getattr(vi_map, table)
    return vi_map.replace(**{table: rows.replace(**{column: getattr(rows, column) + 1.0})})


@pytest.fixture
def session() -> Session:
    session = Session(load_registry())
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
    session = Session(load_registry())
    session.set_flags([f"--undo_max_gb={bound_gb}"])
    session.run("load", map_folder=folders[0])
    for count, folder in enumerate(folders[1:], start=2):
        session.run("load_merge_map", map_folder=folder)
        (line,) = session.run("memory").as_dict()["maps"]
        assert line["undo_gb"] <= bound_gb
        assert line["undo_values"] + line["dropped_values"] == count - 1
    assert line["dropped_values"] > 0
    assert len(session.vi_map.missions) == len(folders)
