"""Maps with several types of descriptors go out with one of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import FlagError, UserError
from maplab_py.interop.colmap.exporting import export_colmap
from maplab_py.interop.colmap.importing import import_colmap
from maplab_py.interop.colmap.options import ColmapExportOptions
from tests.vimap.test_keypoint_removal import two_types


@pytest.mark.parametrize(("name", "number"), [("SIFT", 3), ("Binary", 0)])
def test_a_database_of_one_type(tmp_path: Path, name: str, number: int) -> None:
    vi_map = two_types()
    options = ColmapExportOptions(quality="all", colmap_database=True, colmap_feature_type=name)
    export_colmap(vi_map, tmp_path, options)
    again, _ = import_colmap(tmp_path, database=tmp_path / "database.db")
    of_type = vi_map.feature_type == number
    assert len(again.keypoints) == np.count_nonzero(of_type)
    size = 128 if number else 48
    np.testing.assert_array_equal(
        again.keypoints.descriptor[:, :size], vi_map.keypoints.descriptor[of_type, :size]
    )
    assert set(again.feature_type.tolist()) == {number}


def test_types_that_are_not_there(tmp_path: Path) -> None:
    vi_map = two_types()
    with pytest.raises(UserError, match="no such keypoints; its types: Binary, SIFT"):
        export_colmap(vi_map, tmp_path, ColmapExportOptions(colmap_feature_type="R2D2"))
    with pytest.raises(FlagError, match="--colmap_feature_type: surf is no feature type"):
        export_colmap(vi_map, tmp_path, ColmapExportOptions(colmap_feature_type="surf"))
    assert list(tmp_path.iterdir()) == []
