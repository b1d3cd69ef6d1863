"""Two maps are the same when every number and text is."""

from __future__ import annotations

import numpy as np

from maplab_py.vimap.comparison import is_same
from tests.vimap.builders import walk_map


def test_equal_content_is_the_same_whichever_array_holds_it() -> None:
    a = walk_map(seed=1)
    assert is_same(a, walk_map(seed=1))
    v_M = a.vertices.v_M.copy()
    assert is_same(a, a.replace(vertices=a.vertices.replace(v_M=v_M)))
    v_M[0, 0] = np.nan
    odd = a.replace(vertices=a.vertices.replace(v_M=v_M))
    assert is_same(odd, odd.replace(vertices=odd.vertices.replace(v_M=v_M.copy())))


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
        assert not is_same(a, changed)
