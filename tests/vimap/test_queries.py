"""Queries, rows by id, and maps that are the same."""

import numpy as np
import pytest

from maplab_py.errors import UserError
from maplab_py.vimap import IdIndex, VIMap, comparison, merge, random_ids, statistics, to_hex
from maplab_py.vimap import ids as ids_module
from maplab_py.vimap.consistency import check_consistency
from maplab_py.vimap.queries import (
    coobservation_counts,
    find_mission,
    limits_from_above,
    observer_counts,
)
from tests.vimap.builders import walk_map


def test_missions_are_found_by_prefix():
    m, _ = merge.merge_maps(walk_map(), walk_map(seed=1))
    names = [to_hex(row) for row in m.missions.id]
    assert [find_mission(m, name[:12].upper()) for name in names] == [0, 1]
    for wrong in ("", "zz", names[0] + "0"):
        with pytest.raises(UserError, match=names[1]):
            find_mission(m, wrong)


def test_an_ambiguous_prefix_lists_the_candidates():
    m, _ = merge.merge_maps(walk_map(), walk_map(seed=1))
    ids = m.missions.id.copy()
    ids[1, 0] = ids[0, 0]
    m = m.replace(missions=m.missions.replace(id=ids))
    with pytest.raises(UserError, match="ambiguous"):
        find_mission(m, to_hex(ids[0])[:16])


def test_a_map_without_missions_says_so():
    with pytest.raises(UserError, match="no missions"):
        find_mission(VIMap(), "0")
    assert check_consistency(VIMap()).failure == ""
    assert statistics.map_statistics(VIMap()).missions == ()


def test_statistics_add_up():
    m, _ = merge.merge_maps(walk_map(), walk_map(seed=1))
    report = statistics.map_statistics(m)
    assert sum(s.observations for s in report.missions) == len(m.observations)
    assert sum(s.landmarks_good for s in report.missions) == len(m.landmarks)
    assert report.total is not None
    assert report.total.vertices == len(m.vertices)
    assert len(statistics.coobservability(m).clusters) == 2
    seen = np.diff(m.observation_start) > 0
    assert coobservation_counts(m).trace() == np.count_nonzero(seen)
    np.testing.assert_array_equal(observer_counts(m), np.diff(m.observation_start))


@pytest.mark.parametrize(
    ("table", "column", "value", "rule"),
    [
        ("vertices", "T_M_I", np.nan, "non-finite"),
        ("vertices", "T_M_I", 2.0, "unit length"),
        ("landmarks", "p_I", np.inf, "non-finite"),
        ("landmarks", "vertex", 99, "without store vertex"),
        ("keypoints", "landmark", 99, "not there"),
        ("vertices", "timestamp_ns", 10**12, "out of order"),
        ("imu_samples", "timestamp_ns", 10**12, "do not increase"),
        ("missions", "sensor_id", 5, "not in sensors.yaml"),
        ("missions", "root_vertex", 3, "root"),
        ("imu_edges", "to_vertex", 0, "itself"),
        ("loop_closure_edges", "switch_variable", 1.5, "switch variable"),
    ],
)
def test_what_is_wrong_is_named(table, column, value, rule):
    m = walk_map()
    rows = getattr(m, table)
    values = rows.columns()[column].copy()
    values[0] = value
    report = check_consistency(m.replace(**{table: rows.replace(**{column: values})}))
    assert any(rule in violation.rule for violation in report.errors), report.errors
    assert report.failure


def test_double_ids_and_gaps_are_found():
    m = walk_map()
    ids = m.landmarks.id.copy()
    ids[4] = ids[3]
    twice = check_consistency(m.replace(landmarks=m.landmarks.replace(id=ids)))
    assert [v.rule for v in twice.errors] == ["landmark id that occurs twice"]
    cut = m.replace(transformation_edges=m.transformation_edges.take([0]))
    keep = np.arange(len(m.imu_edges)) != 6
    samples = np.repeat(keep, m.imu_edges.sample_count)
    cut = cut.replace(imu_edges=m.imu_edges.take(keep), imu_samples=m.imu_samples.take(samples))
    (violation,) = check_consistency(cut).errors
    assert violation.where == (to_hex(m.vertices.id[6]),)


@pytest.mark.parametrize("collide", [False, True])
def test_rows_of_ids(collide: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if collide:
        monkeypatch.setattr(ids_module, "_mixed", lambda ids: ids[:, 0] % np.uint64(7))
    rng = np.random.default_rng(2)
    column, others = random_ids(200, rng), random_ids(50, rng)
    wanted = rng.integers(0, 200, 300)
    index = IdIndex(column)
    np.testing.assert_array_equal(index.rows(column[wanted]), wanted)
    assert (index.rows(others) == -1).all()
    assert index.rows(others[:0]).shape == (0,)
    assert (IdIndex(column[:0]).rows(others) == -1).all()


def test_ids_that_differ_in_one_word_only() -> None:
    column = np.array([[1, 2], [1, 3], [2, 2], [0, 0], [2, 1]], dtype=np.uint64)
    np.testing.assert_array_equal(IdIndex(column).rows(column[::-1]), [4, 3, 2, 1, 0])


def test_equal_content_is_the_same_whichever_array_holds_it() -> None:
    a = walk_map(seed=1)
    assert comparison.is_same(a, walk_map(seed=1))
    v_M = a.vertices.v_M.copy()
    assert comparison.is_same(a, a.replace(vertices=a.vertices.replace(v_M=v_M)))
    v_M[0, 0] = np.nan
    odd = a.replace(vertices=a.vertices.replace(v_M=v_M))
    assert comparison.is_same(odd, odd.replace(vertices=odd.vertices.replace(v_M=v_M.copy())))


def test_any_change_makes_another_map() -> None:
    a = walk_map(seed=1)
    quality = a.landmarks.quality.copy()
    quality[-1] += 1
    unknown = a.missions.unknown.copy()
    unknown[0] = b"x"
    metadata = type(a.metadata)(description="another")
    for changed in (
        a.replace(landmarks=a.landmarks.replace(quality=quality)),
        a.replace(landmarks=a.landmarks.take(np.arange(3))),
        a.replace(missions=a.missions.replace(unknown=unknown)),
        a.replace(metadata=metadata),
        a.replace(sensors=type(a.sensors)()),
    ):
        assert not comparison.is_same(a, changed)


def test_a_picture_from_above_leaves_out_what_has_no_place() -> None:
    whole = walk_map(seed=1)
    T_M_I, p_I = np.array(whole.vertices.T_M_I), np.array(whole.landmarks.p_I)
    T_M_I[-1, 4:] = np.nan
    p_I[3] = np.nan
    vi_map = whole.replace(
        vertices=whole.vertices.replace(T_M_I=T_M_I), landmarks=whole.landmarks.replace(p_I=p_I)
    )
    low, high = limits_from_above(vi_map)
    path = vi_map.T_G_I[:-1, 4:6]
    assert (low < path.min(axis=0)).all()
    assert (high > path.max(axis=0)).all()
