"""Ellipsoids lie where the measurements are, with the axes of their covariances."""

from __future__ import annotations

import numpy as np
import pytest

from maplab_py.errors import FlagError
from maplab_py.geometry import se3, so3
from maplab_py.viewer.building import Subject, build_scene
from maplab_py.viewer.layers import covariances
from maplab_py.viewer.layers.covariances import ABSOLUTE_POSES, LOOP_CLOSURES, ellipsoids
from maplab_py.viewer.options import VisualizationOptions
from maplab_py.viewer.scene import Entity, Segments
from maplab_py.vimap import AbsolutePoses, VIMap
from tests.vimap.builders import walk_map


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


def test_of_very_many_only_some_are_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(covariances, "_MAX_ELLIPSOIDS", 1)
    vi_map = with_covariances(np.random.default_rng(5))
    options = VisualizationOptions(lc_edge_covariances=True)
    layer = build_scene(Subject(vi_map, options=options)).layer(LOOP_CLOSURES)
    assert layer.title == "Loop closure covariances (one of 2)"
    assert layer.drawn == 72
