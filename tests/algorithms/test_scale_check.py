"""Scale of maps against their accelerometers."""

import dataclasses

import numpy as np
import pytest

from maplab_py.algorithms.scale_check import mission_scales, scale_doubts
from maplab_py.vimap import ImuEdges, VIMap
from tests.frontend.simulated import replayed


def scaled(factor: float, noise_m: float = 0.0) -> VIMap:
    """Return a simulated map with other lengths and noisy positions."""
    vi_map, _ = replayed()
    T_M_I = vi_map.vertices.T_M_I.copy()
    T_M_I[:, 4:] *= factor
    T_M_I[:, 4:] += np.random.default_rng(1).normal(0.0, noise_m, (len(T_M_I), 3))
    vertices = dataclasses.replace(vi_map.vertices, T_M_I=T_M_I, v_M=factor * vi_map.vertices.v_M)
    return dataclasses.replace(vi_map, vertices=vertices)


@pytest.mark.parametrize("factor", [0.1, 0.5, 1.0, 1.8])
@pytest.mark.parametrize("noise_m", [0.0, 2e-3])
def test_the_scale_shows(factor: float, noise_m: float) -> None:
    vi_map = scaled(factor, noise_m)
    (found,) = mission_scales(vi_map)
    assert found.scale == pytest.approx(factor, rel=0.2)
    doubts = scale_doubts(vi_map)
    assert len(doubts) == (factor != 1.0)
    assert all("mission 1 of 1: lengths are" in doubt for doubt in doubts)


def test_a_map_without_imu_has_no_scale() -> None:
    vi_map, _ = replayed()
    assert mission_scales(dataclasses.replace(vi_map, imu_edges=ImuEdges.empty())) == ()
