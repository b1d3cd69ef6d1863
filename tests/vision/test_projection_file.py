import numpy as np
import pytest

from maplab_py.errors import UserError
from maplab_py.vision.projection import DescriptorProjection, load_projection, save_projection


def test_a_projection_comes_back(tmp_path):
    matrix = np.random.default_rng(0).normal(size=(10, 384)).astype(np.float32)
    path = tmp_path / "folder" / "projection.npz"
    save_projection(DescriptorProjection(matrix), path)
    again = load_projection(path)
    np.testing.assert_array_equal(again.matrix, matrix)
    assert again.descriptor_size == 48
    with pytest.raises(UserError, match="--overwrite"):
        save_projection(again, path)
    save_projection(again, path, overwrite=True)


def test_wrong_files_are_errors(tmp_path):
    with pytest.raises(UserError, match="cannot read"):
        load_projection(tmp_path / "nowhere.npz")
    (tmp_path / "text.npz").write_text("matrix")
    with pytest.raises(UserError, match="train_projection_matrix"):
        load_projection(tmp_path / "text.npz")
    np.savez(tmp_path / "odd.npz", matrix=np.zeros((10, 383)))
    with pytest.raises(UserError, match="descriptor"):
        load_projection(tmp_path / "odd.npz")
