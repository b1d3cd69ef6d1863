"""Slices through distance fields at heights of the global frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from maplab_py.algorithms.dense.field import FIELD_TYPE, DistanceField, encode_field
from maplab_py.errors import UserError
from maplab_py.storage.resources.new import NewResources
from maplab_py.viewer import colours
from maplab_py.viewer.mesh_sources import field_slice
from maplab_py.vimap import ResourceOwner, VIMap
from tests.vimap.builders import walk_map


@pytest.fixture
def vi_map(tmp_path: Path) -> VIMap:
    """Return a map with a field of one block that grows with the height; one voxel is unknown."""
    distance = np.zeros((1, 8, 8, 8), dtype=np.float32) + 0.1 * np.arange(8, dtype=np.float32)
    distance[0, 2, 3, 4] = np.nan
    field = DistanceField(0.1, 2.0, np.zeros((1, 3), dtype=np.int32), distance)
    new = NewResources(tmp_path)
    rows = [new.add(FIELD_TYPE, encode_field(field))]
    plain = walk_map(vertices=3, landmarks=4)
    T_G_M = np.array(plain.baseframes.T_G_M)
    T_G_M[:] = [0.0, 0.0, 0.0, 1.0, 5.0, 0.0, 1.0]
    plain = plain.replace(baseframes=plain.baseframes.replace(T_G_M=T_G_M))
    return new.attached(plain, rows, [0], ResourceOwner.MISSION)


def test_a_slice_has_the_known_voxels_of_its_height(vi_map: VIMap) -> None:
    cloud = field_slice(vi_map, Path(), None, 1.45)
    assert cloud.p_G.shape == (63, 3)
    np.testing.assert_allclose(cloud.p_G[:, 2], 1.45)
    assert cloud.p_G[:, 0].min() == pytest.approx(5.05)
    assert (cloud.legend[0].low, cloud.legend[0].high) == ("0.4 m", "0.4 m")
    between = field_slice(vi_map, Path(), None, 1.40)
    assert len(between.p_G) == 63 + 64
    assert between.colours is not None
    nearest = np.argmin(between.p_G[:, 2])
    np.testing.assert_array_equal(between.colours[nearest], colours.SEQUENTIAL[-1])


def test_heights_without_voxels_are_refused(vi_map: VIMap) -> None:
    with pytest.raises(UserError, match=r"has voxels from 1\.05 m to 1\.75 m"):
        field_slice(vi_map, Path(), None, 3.0)
