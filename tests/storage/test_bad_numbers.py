"""Maps with entries that are no numbers: save refuses what load refuses, and both repair."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maplab_py.errors import MapError
from maplab_py.storage import map_saving
from maplab_py.storage.native import load_map, save_map
from maplab_py.vimap import VIMap
from maplab_py.vimap.consistency import check_saved
from maplab_py.vimap.number_repair import without_bad_numbers
from tests.interop.small_map import VERTICES
from tests.interop.small_map import make_map as rootless_map

PLACES = [
    ("landmarks", "p_I", "1 landmark without finite numbers dropped"),
    ("vertices", "T_M_I", "1 vertex without finite numbers dropped"),
    ("vertices", "v_M", "1 vertex with a v_M that is no number set to zero"),
    ("vertices", "gyro_bias", "1 vertex with a gyro_bias that is no number set to zero"),
    ("keypoints", "uv_px", "1 keypoint without finite numbers dropped"),
    ("baseframes", "T_G_M", "1 base frame without a finite pose taken as unknown"),
]


def make_map() -> VIMap:
    vi_map = rootless_map()
    return vi_map.replace(
        missions=vi_map.missions.replace(root_vertex=np.array([0, VERTICES], dtype=np.int32))
    )


def with_value(vi_map: VIMap, field: str, name: str, value: Any, row: int = 1) -> VIMap:
    table: Any = getattr(vi_map, field)
    values = np.array(table.columns()[name], dtype=np.float64)
    values[row] = values[row] * value
    return vi_map.replace(**{field: table.replace(**{name: values})})


def save_unchecked(vi_map: VIMap, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Save what other programs, and older versions, saved."""
    with monkeypatch.context() as patch:
        patch.setattr(map_saving, "check_loadable", lambda *_: None)
        save_map(vi_map, folder)


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize(("field", "name", "said"), PLACES)
def test_save_refuses_what_load_refuses_and_both_repair(
    field: str, name: str, said: str, value: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with np.errstate(invalid="ignore"):
        bad = with_value(make_map(), field, name, value)
        bad = with_value(bad, field, name, np.nan)
    with pytest.raises(MapError, match=r"not saved.*non-finite.*--repair") as caught:
        save_map(bad, tmp_path / "refused")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "refused").exists()
    save_unchecked(bad, tmp_path / "other", monkeypatch)
    with pytest.raises(MapError, match=r"not a number; load with --repair"):
        load_map(tmp_path / "other")
    repaired, report = load_map(tmp_path / "other", repair=True)
    assert said in report.notes
    assert check_saved(repaired) == []
    assert said in save_map(bad, tmp_path / "repaired", repair=True).notes
    again, report = load_map(tmp_path / "repaired")
    assert len(again.vertices) == len(repaired.vertices)
    np.testing.assert_array_equal(again.landmarks.id, repaired.landmarks.id)


@pytest.mark.parametrize("factor", [1.1, 1e200])
def test_quaternions_of_another_length_are_scaled(
    factor: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    vi_map = make_map()
    bad = with_value(vi_map, "vertices", "T_M_I", np.array([factor] * 4 + [1.0] * 3))
    with pytest.raises(MapError, match="not of unit length"):
        save_map(bad, tmp_path / "map")
    save_unchecked(bad, tmp_path / "map", monkeypatch)
    with pytest.raises(MapError, match=r"has length .*, not 1"):
        load_map(tmp_path / "map")
    repaired, report = load_map(tmp_path / "map", repair=True)
    assert "1 quaternion of vertices scaled to unit length" in report.notes
    np.testing.assert_allclose(repaired.vertices.T_M_I, vi_map.vertices.T_M_I, atol=1e-12)


def test_references_and_ids_are_checked_before_saving(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="mission without root vertex"):
        save_map(rootless_map(), tmp_path / "a")
    vi_map = make_map()
    vertex = vi_map.landmarks.vertex.copy()
    vertex[0] = len(vi_map.vertices)
    with pytest.raises(MapError, match="landmark without store vertex"):
        save_map(vi_map.replace(landmarks=vi_map.landmarks.replace(vertex=vertex)), tmp_path / "a")
    ids = vi_map.landmarks.id.copy()
    ids[1] = ids[0]
    with pytest.raises(MapError, match="landmark id that occurs twice"):
        save_map(vi_map.replace(landmarks=vi_map.landmarks.replace(id=ids)), tmp_path / "a")


def test_a_sound_map_stays_what_it_is(tmp_path: Path) -> None:
    vi_map = make_map()
    same, notes = without_bad_numbers(vi_map)
    assert notes == []
    assert same.landmarks is vi_map.landmarks
    assert save_map(vi_map, tmp_path / "map", repair=True).notes == ()


def test_a_mission_without_any_pose_goes() -> None:
    vi_map = make_map()
    T = vi_map.vertices.T_M_I.copy()
    T[vi_map.vertices.mission == 1] = np.nan
    left, notes = without_bad_numbers(vi_map.replace(vertices=vi_map.vertices.replace(T_M_I=T)))
    assert len(left.missions) == 1
    assert any("vertices without finite numbers dropped" in note for note in notes)
    assert check_saved(left) == []
