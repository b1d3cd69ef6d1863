"""What the map remembers of its loop closures, in the viewer."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from maplab_py.algorithms.loop_closure.closure_record import FIELD_NUMBER, read_record, write_record
from maplab_py.algorithms.loop_closure.closure_table import VERDICTS
from maplab_py.algorithms.loop_closure.explanation import explain_closure
from maplab_py.algorithms.loop_closure.listing import list_closures, near_miss_order
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.reports import Verdict
from maplab_py.algorithms.loop_closure.workflow import close_loops
from maplab_py.errors import FlagError
from maplab_py.storage.extension_fields import with_extension
from maplab_py.viewer import colours
from maplab_py.viewer.building import Subject, build_scene
from maplab_py.viewer.facts import facts
from maplab_py.viewer.layers.closures import ACCEPTED, REFUSED
from maplab_py.viewer.options import VisualizationOptions
from maplab_py.viewer.picking import pick
from maplab_py.viewer.scene import WHOLE_MAP, Entity, Layer, Segments
from maplab_py.vimap import LoopClosureEdges, VIMap
from tests.algorithms.loop_closure.rooms import Walk, make_map


@pytest.fixture(scope="module")
def closed() -> VIMap:
    walks = [Walk(room=1), Walk(room=1, start_s=60.0, drift=(0.2, -0.1, 0.05, 0.01))]
    vi_map, _ = make_map(walks)
    merged, report = close_loops(vi_map)
    assert report.accepted >= 8
    # the first two accepted ones lose weight, as relaxation may leave them; three are refused
    record = read_record(merged)
    weight, verdict = record.closures.weight.copy(), record.closures.verdict.copy()
    weight[:2] = 0.0, 0.5
    verdict[-3:] = VERDICTS.index(Verdict.FEW_INLIERS)
    closures = record.closures.replace(weight=weight, verdict=verdict)
    return write_record(merged, dataclasses.replace(record, closures=closures))


def _rows(vi_map: VIMap, *, accepted: bool) -> list[int]:
    listed = list_closures(vi_map, which="accepted").closures
    names = {line.id for line in listed}
    ids = [f"{int(first):016x}"[:8] for first in read_record(vi_map).closures.id[:, 0]]
    return [row for row, name in enumerate(ids) if (name in names) == accepted]


def _segments(vi_map: VIMap, layer: str) -> Segments:
    part = build_scene(Subject(vi_map)).layer(layer).parts[WHOLE_MAP]
    assert isinstance(part, Segments)
    return part


def test_accepted_and_refused_closures_are_layers_of_their_own(closed: VIMap) -> None:
    record = read_record(closed).closures
    for layer, accepted in ((ACCEPTED, True), (REFUSED, False)):
        part = _segments(closed, layer)
        np.testing.assert_array_equal(part.rows, _rows(closed, accepted=accepted))
        for end, ids in ((0, record.query), (1, record.place)):
            p = closed.T_G_I[closed.vertex_index.rows(ids[part.rows]), 4:]
            np.testing.assert_allclose(part.ends[:, end], p, atol=1e-5)
        assert not build_scene(Subject(closed)).layer(layer).is_visible
    colour = _segments(closed, ACCEPTED).colours
    np.testing.assert_array_equal(colour[:3], colours.TRUST[[0, 1, 2]])


def test_a_click_tells_what_the_report_lists(closed: VIMap) -> None:
    scene = build_scene(Subject(closed, only_layers=(ACCEPTED,)))
    part = _segments(closed, ACCEPTED)
    middle = part.ends[2].mean(axis=0).astype(float)
    eye = middle + np.array([0.3, -2.0, 5.0])
    found = pick(scene, eye, middle - eye, layers={ACCEPTED})
    assert found is not None
    assert found.entity is Entity.CLOSURE
    named = dict(facts(closed, found.entity, found.row))
    lines = {line.id: line for line in list_closures(closed, which="all").closures}
    line = lines[named["closure"]]
    assert named["verdict"] == "accepted"
    assert named["inliers"].startswith(f"{line.inliers} (")
    assert named["query"] == f"mission {line.query} at {line.query_s:.2f} s"
    assert named["gap now"] == f"{line.gap_m:.3f} m, {line.gap_deg:.2f} deg"


def test_a_damaged_record_is_said_and_the_map_shown(closed: VIMap) -> None:
    unknown = closed.missions.unknown.copy()
    unknown[0] = with_extension(unknown[0], FIELD_NUMBER, b"LC1 rubbish")
    damaged = closed.replace(missions=closed.missions.replace(unknown=unknown))
    scene = build_scene(Subject(damaged))
    assert ACCEPTED not in {layer.name for layer in scene.layers}
    assert any("record of loop closures is damaged" in note for note in scene.notes)


def test_a_click_tells_why_gate_by_gate(closed: VIMap) -> None:
    row = _rows(closed, accepted=False)[0]
    named = dict(facts(closed, Entity.CLOSURE, row))
    explanation = explain_closure(closed, row, LoopClosureOptions())
    assert named["why"] == explanation.summary
    shown = {name: value for name, value in named.items() if name.startswith(("passed", "failed"))}
    assert len(shown) == len(explanation.gates) >= 4
    for gate in explanation.gates:
        assert shown[f"{gate.result}: {gate.gate}"].startswith(
            f"{gate.value}, wanted {gate.wanted}"
        )
    assert "--lc_min_inlier_count" in named["passed: inliers"]


def test_an_edge_tells_the_gates_of_the_closure_it_was_made_from(closed: VIMap) -> None:
    record = read_record(closed).closures
    row = _rows(closed, accepted=True)[0]
    edges = LoopClosureEdges.filled(
        2,
        id=np.array([record.id[row], [5, 6]], dtype=np.uint64),
        from_vertex=closed.vertex_index.rows(record.query[[row, row]]),
        to_vertex=closed.vertex_index.rows(record.place[[row, row]]),
    )
    with_edges = closed.replace(loop_closure_edges=edges)
    assert "passed: inliers" in dict(facts(with_edges, Entity.LOOP_CLOSURE, 0))
    assert "why" not in dict(facts(with_edges, Entity.LOOP_CLOSURE, 1))


def _refused(vi_map: VIMap, **flags: object) -> Layer:
    options = VisualizationOptions(**flags)  # type: ignore[arg-type]
    return build_scene(Subject(vi_map, options=options)).layer(REFUSED)


def _drawn_rows(layer: Layer) -> list[int]:
    part = layer.parts[WHOLE_MAP]
    assert isinstance(part, Segments)
    return part.rows.tolist()


def test_refused_closures_are_restricted_to_a_reason(closed: VIMap) -> None:
    record = read_record(closed)
    verdict = record.closures.verdict.copy()
    verdict[-1] = VERDICTS.index(Verdict.TILTED)
    closures = record.closures.replace(verdict=verdict)
    mixed = write_record(closed, dataclasses.replace(record, closures=closures))
    layer = _refused(mixed, refused_closures_reason="Gravity")
    assert _drawn_rows(layer) == [len(verdict) - 1]
    assert layer.choices == ("too few inliers", "gravity deviates")
    assert layer.notes == ("Refused closures: 1 of 3 are drawn (left out: 2 for another reason)",)
    assert _refused(mixed).notes == ()


def test_the_best_refused_closures_are_drawn(closed: VIMap) -> None:
    order = near_miss_order(read_record(closed).closures)
    rows = np.array(_rows(closed, accepted=False))
    best = rows[np.argsort(order[rows], kind="stable")[:2]]
    layer = _refused(closed, max_refused_closures=2)
    assert _drawn_rows(layer) == sorted(best.tolist())
    assert layer.total == 3
    assert "1 by --vis_max_refused_closures" in layer.notes[0]


@pytest.mark.parametrize(
    "flags", [{"max_refused_closures": -1}, {"refused_closures_reason": "weather"}]
)
def test_bad_restrictions_are_refused(flags: dict[str, object]) -> None:
    with pytest.raises(FlagError, match=f"--vis_{next(iter(flags))}"):
        VisualizationOptions(**flags)  # type: ignore[arg-type]
