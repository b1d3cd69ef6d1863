"""Public pose graphs against the optima that SE-Sync certifies (Rosen et al., IJRR 2019, table 1)."""

from __future__ import annotations

import numpy as np
import pytest

from maplab_py.algorithms.relaxation.losses import quadratic
from maplab_py.algorithms.relaxation.optimizer import PoseGraphOptimizer
from maplab_py.algorithms.relaxation.pose_graph import RelativePoses, TiltPriors
from maplab_py.progress import SILENT
from tests.support.data import shared_data


def _read_g2o(path):
    """Return poses (V, 7) and edges, isotropic in position and in angle as SE-Sync takes them."""
    lines = [line.split() for line in path.read_text().splitlines()]
    poses = np.array([line[2:9] for line in lines if line[0] == "VERTEX_SE3:QUAT"], dtype=float)
    edges = np.array([line[1:] for line in lines if line[0] == "EDGE_SE3:QUAT"], dtype=float)
    information = np.zeros((len(edges), 6, 6))
    information[:, *np.triu_indices(6)] = edges[:, 9:30]
    diagonal = np.einsum("eii->ei", information)
    upper = information + np.triu(information, 1).transpose(0, 2, 1)
    covariance = np.linalg.inv(upper)
    position = 3.0 / np.einsum("eii->e", covariance[:, :3, :3])
    angle = 3.0 / np.einsum("eii->e", covariance[:, 3:, 3:])
    assert np.all(diagonal > 0)
    W = np.sqrt(np.stack([position] * 3 + [angle] * 3, axis=1))[:, :, None] * np.eye(6)
    a, b = edges[:, 0].astype(np.int64), edges[:, 1].astype(np.int64)
    return poses[:, [3, 4, 5, 6, 0, 1, 2]], RelativePoses(a, b, edges[:, [5, 6, 7, 8, 2, 3, 4]], W)


@pytest.mark.parametrize(
    ("name", "optimum", "tolerance"),
    [
        ("parking-garage", 1.263, 2e-3),
        ("smallGrid3D", 1025.4, 2e-2),  # SE-Sync's chordal distance is not the angle: noise 0.2 rad
    ],
)
def test_optimum_of_public_graph(name, optimum, tolerance):
    T, edges = _read_g2o(shared_data(f"g2o/{name}.g2o"))
    # g2o quaternions are printed with six digits
    T[:, :4] /= np.linalg.norm(T[:, :4], axis=1, keepdims=True)
    edges.T_A_B[:, :4] /= np.linalg.norm(edges.T_A_B[:, :4], axis=1, keepdims=True)
    is_free = np.arange(len(T)) > 0
    none = TiltPriors.of_vertices(np.zeros(0, dtype=np.int64), T, 1.0)
    empty = edges.take(np.zeros(0, dtype=np.int64))
    optimizer = PoseGraphOptimizer(is_free, edges, empty, none, quadratic)
    solution, iterations = optimizer.run(T, 1.0, 50, SILENT)
    assert optimizer.cost(solution, 1.0) == pytest.approx(optimum, rel=tolerance)
    assert iterations < 30
