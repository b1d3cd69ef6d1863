"""Layers of closures, clouds, compared maps and covariances."""

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
from maplab_py.geometry import se3, so3
from maplab_py.storage.extension_fields import with_extension
from maplab_py.viewer import colours
from maplab_py.viewer.building import Subject, build_scene
from maplab_py.viewer.drawing import make_drawing
from maplab_py.viewer.facts import facts
from maplab_py.viewer.layers.closures import ACCEPTED, REFUSED
from maplab_py.viewer.layers.clouds import Cloud
from maplab_py.viewer.layers.covariances import ABSOLUTE_POSES, LOOP_CLOSURES, ellipsoids
from maplab_py.viewer.layers.coverage import SeenVolume, _crossings, next_walks, seen_volume
from maplab_py.viewer.options import VisualizationOptions
from maplab_py.viewer.picking import pick
from maplab_py.viewer.scene import WHOLE_MAP, Entity, Layer, Mesh, Points, Scene, Segments
from maplab_py.vimap import AbsolutePoses, LoopClosureEdges, VIMap
from maplab_py.vimap.merge import merge_maps
from tests.algorithms.loop_closure.rooms import Walk, make_map
from tests.vimap.builders import walk_map


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
        assert build_scene(Subject(closed)).layer(layer).is_visible == accepted
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


RAMP = tuple(colours.hex_codes(colours.SEQUENTIAL))


def _scene(*clouds: Cloud) -> Scene:
    return build_scene(Subject(walk_map(), "test", clouds=clouds))


def _line(low: float, high: float) -> np.ndarray:
    p = np.zeros((200, 3))
    p[:, 2] = np.linspace(low, high, 200)
    return p


def test_clouds_of_one_title_share_one_ramp_and_its_legend() -> None:
    scene = _scene(Cloud("scan", _line(0.0, 1.0)), Cloud("scan", _line(9.0, 10.0)))
    layer = scene.layer("cloud_0")
    (entry,) = layer.legend
    assert entry.text == "scan: height"
    assert entry.colours == RAMP
    assert float(entry.low.removesuffix(" m")) < 0.1
    assert float(entry.high.removesuffix(" m")) > 9.9
    part = layer.parts[""]
    assert isinstance(part, Points)
    low = part.colours[part.p[:, 2] <= 1.0]
    assert (np.abs(low.astype(int) - colours.SEQUENTIAL[0]).max(axis=1) < 60).all()


def test_intensity_has_no_unit() -> None:
    intensity = np.linspace(0.0, 250.0, 200)
    (entry,) = _scene(Cloud("lidar", _line(0.0, 1.0), intensity=intensity)).layer("cloud_0").legend
    assert entry.text == "lidar: intensity"
    assert float(entry.high) > 240.0


def _both(vi_map: VIMap, other: VIMap) -> tuple[Scene, Segments, Points]:
    scene = build_scene(
        Subject(vi_map, "after", other=other, other_name="snapshot 'before'", arrangement="beside")
    )
    path = scene.layer("reference_trajectories").parts[""]
    names = scene.layer("names").parts[""]
    assert isinstance(path, Segments)
    assert isinstance(names, Points)
    return scene, path, names


@pytest.fixture(scope="module")
def two_missions() -> VIMap:
    return merge_maps(walk_map(seed=1), walk_map(vertices=9, seed=2, first_ns=10**10))[0]


def test_another_state_lies_beside_the_map_along_its_longer_side(two_missions: VIMap) -> None:
    scene, path, names = _both(two_missions, two_missions)
    shift = path.ends[0, 0] - two_missions.T_G_I[0, 4:]
    np.testing.assert_allclose(
        path.ends[:, 0], two_missions.T_G_I[path.rows, 4:] + shift, atol=1e-4
    )
    outline = build_scene(Subject(two_missions)).extent.outline
    across = int(np.argmin(np.ptp(outline[:, :2], axis=0)))
    assert np.count_nonzero(np.abs(shift) > 1e-4) == 1
    assert shift[across] < -np.ptp(outline[:, across])
    assert names.labels == ("after", "snapshot 'before'")
    np.testing.assert_allclose(names.p[1] - names.p[0], shift, atol=1e-4)
    assert scene.notes[0] == "beside it: snapshot 'before'"
    seen = np.concatenate([names.p, path.ends[:, 0]])
    low, high = scene.extent.outline.min(axis=0), scene.extent.outline.max(axis=0)
    assert ((seen >= low - 1.5) & (seen <= high + 1.5)).all()


def test_missions_have_one_colour_on_both_sides(two_missions: VIMap) -> None:
    _, path, _ = _both(two_missions, two_missions)
    expected = colours.mission_colours(2)[two_missions.vertices.mission[path.rows]]
    np.testing.assert_array_equal(path.colours, expected)


def test_a_map_with_nothing_in_common_is_centred_and_has_new_colours(two_missions: VIMap) -> None:
    stranger = walk_map(seed=9)
    base = stranger.baseframes
    T = np.array(base.T_G_M)
    T[:, 4:] += [5_000.0, 300.0, 20.0]
    far = stranger.replace(baseframes=base.replace(T_G_M=T))
    scene, path, _ = _both(two_missions, far)
    assert np.abs(path.ends - scene.extent.centre).max() < 4.0 * scene.extent.radius_m
    assert (path.colours == colours.mission_colours(3)[2]).all()
    cloud = scene.layer("reference_landmarks").parts[""]
    assert isinstance(cloud, Points)
    assert (cloud.colours == colours.mission_colours(3)[2]).all()


def with_covariances(rng: np.random.Generator) -> VIMap:
    """Return a map whose edges and absolute poses have random covariances, one of them unknown."""
    vi_map = walk_map()
    edges = vi_map.loop_closure_edges
    poses = AbsolutePoses.filled(
        3,
        vertex=np.array([0, 4, 9]),
        T_G_S=vi_map.T_G_I[[0, 4, 9]],
        covariance=random_covariances(3, rng),
    )
    covariance = poses.covariance.copy()
    covariance[1] = np.nan
    return vi_map.replace(
        loop_closure_edges=edges.replace(covariance=random_covariances(len(edges), rng)),
        absolute_poses=poses.replace(covariance=covariance),
    )


def random_covariances(count: int, rng: np.random.Generator) -> np.ndarray:
    A = rng.normal(size=(count, 6, 6))
    return 0.01 * A @ np.swapaxes(A, 1, 2)


def layer_of(vi_map: VIMap, name: str, **options: object) -> tuple[np.ndarray, np.ndarray]:
    subject = Subject(vi_map, "test", VisualizationOptions(**options))  # type: ignore[arg-type]
    parts = build_scene(subject).layer(name).parts.values()
    segments = [part for part in parts if isinstance(part, Segments)]
    assert len(segments) == len(parts)
    ends = np.concatenate([part.ends for part in segments])
    return ends.astype(np.float64), np.concatenate([part.rows for part in segments])


def mahalanobis(difference: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    return np.sqrt(np.einsum("ni,ij,nj->n", difference, np.linalg.inv(covariance), difference))


def test_points_of_an_ellipsoid_have_its_mahalanobis_distance() -> None:
    rng = np.random.default_rng(3)
    covariance = random_covariances(4, rng)[:, :3, :3]
    centre = rng.normal(size=(4, 3))
    part = ellipsoids(centre, covariance, np.array([1, 2, 3], np.uint8), np.arange(4), 2.5)
    assert len(part) == 4 * 72
    for row in range(4):
        ends = part.ends[part.rows == row].astype(np.float64)
        distance = mahalanobis(ends.reshape(-1, 3) - centre[row], covariance[row])
        np.testing.assert_allclose(distance, 2.5, atol=1e-4)
        # each ellipse is closed, and the extremes are those of the covariance
        assert {tuple(p) for p in ends[:, 0]} == {tuple(p) for p in ends[:, 1]}
        longest = np.linalg.norm(ends[:, 0] - centre[row], axis=1).max()
        largest = np.sqrt(np.linalg.eigvalsh(covariance[row])[-1])
        assert longest == pytest.approx(2.5 * largest, rel=1e-5)


def test_flat_and_slightly_negative_covariances_are_drawn() -> None:
    covariance = np.diag([0.04, 0.0, -1e-18])[None]
    part = ellipsoids(np.zeros((1, 3)), covariance, np.zeros(3, np.uint8), np.array([7]), 1.0)
    assert np.abs(part.ends[..., 0]).max() == pytest.approx(0.2)
    assert not part.ends[..., 1:].any()


def test_edges_are_seen_from_their_from_vertex() -> None:
    vi_map = with_covariances(np.random.default_rng(1))
    edges = vi_map.loop_closure_edges
    ends, rows = layer_of(vi_map, LOOP_CLOSURES, lc_edge_covariances=True)
    assert np.unique(rows).tolist() == list(range(len(edges)))
    for row in range(len(edges)):
        T_G_A = vi_map.T_G_I[edges.from_vertex[row]]
        p_G = se3.compose(T_G_A, edges.T_A_B[row])[4:]
        R = so3.to_matrix(T_G_A[:4])
        covariance = R @ edges.covariance[row, :3, :3] @ R.T
        distance = mahalanobis(ends[rows == row].reshape(-1, 3) - p_G, covariance)
        np.testing.assert_allclose(distance, 3.0, atol=1e-3)


def test_absolute_poses_without_a_covariance_have_no_ellipsoid() -> None:
    vi_map = with_covariances(np.random.default_rng(2))
    options = {"abs_6dof_constraint_covariances": True, "covariance_scale": 1.0, "offset_z_m": 5.0}
    ends, rows = layer_of(vi_map, ABSOLUTE_POSES, **options)
    assert np.unique(rows).tolist() == [0, 2]
    table = vi_map.absolute_poses
    for row in (0, 2):
        p = table.T_G_S[row, 4:] + [0.0, 0.0, 5.0]
        distance = mahalanobis(ends[rows == row].reshape(-1, 3) - p, table.covariance[row, :3, :3])
        np.testing.assert_allclose(distance, 1.0, atol=1e-3)


def test_layers_are_there_only_when_asked_for() -> None:
    vi_map = with_covariances(np.random.default_rng(4))
    names = build_scene(Subject(vi_map)).names
    assert LOOP_CLOSURES not in names
    assert ABSOLUTE_POSES not in names
    options = VisualizationOptions(lc_edge_covariances=True)
    layer = build_scene(Subject(vi_map, options=options)).layer(LOOP_CLOSURES)
    assert (layer.entity, layer.is_visible) == (Entity.LOOP_CLOSURE, True)
    assert layer.total == len(vi_map.loop_closure_edges)
    with pytest.raises(FlagError, match="--vis_covariance_scale=0: must be above 0"):
        VisualizationOptions(covariance_scale=0.0)


def test_tubes_widen_from_where_the_path_is_held() -> None:
    vi_map = walk_map(vertices=30, landmarks=200, seed=2)
    scene = build_scene(Subject(vi_map, options=VisualizationOptions(coverage=True)))
    (tube,) = scene.layer("uncertainty").parts.values()
    assert isinstance(tube, Mesh)
    rings = tube.p.reshape(len(vi_map.vertices), -1, 3)
    radius = np.linalg.norm(rings - rings.mean(axis=1, keepdims=True), axis=2).max(axis=1)
    np.testing.assert_allclose(rings.mean(axis=1), vi_map.T_G_I[:, 4:], atol=1e-3)
    assert radius[0] < 1e-6 < radius[len(radius) // 4] < radius[-1] < 1.0
    assert tube.opacity < 1.0


def test_volume_that_rays_cross_from_many_sides_has_no_fog() -> None:
    start = np.array([[0.0, 0.0, 0.0], [9.0, 0.0, 0.0], [0.0, 9.0, 0.0]]) + 0.5
    end = start[[1, 0, 0]] * [1.0, 1.0, 1.0]
    seen = _crossings(start, end, np.zeros(3), 1.0, np.array([10, 10, 1]))
    assert seen[5, 0, 0] == 2  # there and back
    assert seen[0, 5, 0] == 1
    assert seen[5, 5, 0] == 0
    counts = np.zeros((9, 9, 3), dtype=np.uint8)
    counts[3:6, 3:6, 1], counts[7, 7, 1] = 3, 1
    fog = SeenVolume(np.zeros(3), 1.0, counts).is_foggy
    assert not fog[4, 4, 1]
    assert fog[2, 4, 1]
    assert fog[4, 4, 2]
    assert fog[7, 7, 1]
    assert not fog[0, 0, 0]


def test_paths_are_coloured_by_time(two_missions: VIMap) -> None:
    options = VisualizationOptions(color_paths_by_time=True)
    layer = build_scene(Subject(two_missions, options=options)).layer("trajectories")
    for part in layer.parts.values():
        assert isinstance(part, Segments)
        np.testing.assert_array_equal(part.colours[0], colours.SEQUENTIAL[0])
        assert len(np.unique(part.colours, axis=0)) > 4
    assert layer.legend[0].low == "0 s"


def test_a_map_that_nothing_determines_has_no_tube_and_says_so() -> None:
    whole = walk_map(seed=1)
    bare = VIMap(missions=whole.missions, baseframes=whole.baseframes, vertices=whole.vertices)
    options = VisualizationOptions(coverage=True)
    scene = build_scene(Subject(bare, options=options))
    assert "uncertainty" not in scene.names
    assert any(note.startswith("Uncertainty of the path: ") for note in scene.notes)


def test_a_lost_vertex_and_a_steep_path_have_a_volume_of_bounded_size() -> None:
    whole = walk_map(seed=1)
    T_M_I = np.array(whole.vertices.T_M_I)
    T_M_I[:, 4:] *= [0.01, 0.01, 50.0]
    T_M_I[0, 4:] = np.nan
    steep = whole.replace(vertices=whole.vertices.replace(T_M_I=T_M_I))
    drawing = make_drawing(steep, VisualizationOptions())
    volume = seen_volume(drawing)
    assert volume is not None
    assert max(volume.directions.shape) <= 69
    assert np.isfinite(next_walks(drawing, volume)).all()
