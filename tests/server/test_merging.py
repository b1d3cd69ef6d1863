"""The joint step of the server: loops that do not close are relaxed first."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from maplab_py.algorithms.landmarks.options import LandmarkQualityOptions
from maplab_py.algorithms.landmarks.quality import evaluate_quality
from maplab_py.server import merging
from maplab_py.server.merging import Merger, stretches_of
from maplab_py.server.options import IncrementalOptions, MergingOptions
from maplab_py.simulation.evaluation import evaluate_map
from maplab_py.vimap import VIMap
from maplab_py.vimap.merge import merge_maps
from tests.server.support import TWO_ROBOTS
from tests.simulation.small import simulated

OFF_M = 1.5


def map_with_a_gap(off_m: float) -> VIMap:
    """Return both robots in their true frames, the second one off by a distance."""
    data = simulated(TWO_ROBOTS)
    vi_map, _ = merge_maps(*data.maps)
    rows = [
        int(np.flatnonzero((data.truth.mission_id == id_).all(axis=1))[0])
        for id_ in vi_map.missions.id
    ]
    T_G_M = vi_map.baseframes.T_G_M.copy()
    T_G_M[vi_map.missions.baseframe] = data.truth.T_G_M[rows]
    T_G_M[vi_map.missions.baseframe[1], 4] += off_m
    frames = vi_map.baseframes.replace(T_G_M=T_G_M, is_known=np.ones(2, dtype=np.bool_))
    return evaluate_quality(vi_map.replace(baseframes=frames), LandmarkQualityOptions())[0]


@pytest.mark.parametrize("off_m", [0.0, OFF_M])
def test_a_gap_is_closed_by_relaxation(off_m: float, monkeypatch: pytest.MonkeyPatch) -> None:
    relaxations: list[int] = []
    relax = merging.relax

    def counted(*arguments: Any, **named: Any) -> Any:
        relaxations.append(len(named["loop_closures"]))
        return relax(*arguments, **named)

    monkeypatch.setattr(merging, "relax", counted)
    vi_map = map_with_a_gap(off_m)
    merger = Merger(MergingOptions(), IncrementalOptions())
    merger.restore(vi_map, stretches_of(vi_map))
    moved_m = merger.optimize_jointly()
    assert len(relaxations) == (off_m > 0.0)
    assert all(relaxations)
    assert merger.vi_map is not None
    assert evaluate_map(merger.vi_map, simulated(TWO_ROBOTS).truth).ate_m < 0.1
    assert moved_m > 0.5 * off_m
