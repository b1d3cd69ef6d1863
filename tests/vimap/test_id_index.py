"""Look-up of rows by id, also when ids collide after mixing."""

from __future__ import annotations

import numpy as np
import pytest

from maplab_py.vimap import ids as ids_module
from maplab_py.vimap.ids import IdIndex, random_ids


@pytest.mark.parametrize("collide", [False, True])
def test_rows_of_ids(collide: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if collide:
        monkeypatch.setattr(ids_module, "_mixed", lambda ids: ids[:, 0] % np.uint64(7))
    rng = np.random.default_rng(2)
    column, others = random_ids(200, rng), random_ids(50, rng)
    wanted = rng.integers(0, 200, 300)
    index = IdIndex(column)
    np.testing.assert_array_equal(index.rows(column[wanted]), wanted)
    assert (index.rows(others) == -1).all()
    assert index.rows(others[:0]).shape == (0,)
    assert (IdIndex(column[:0]).rows(others) == -1).all()


def test_ids_that_differ_in_one_word_only() -> None:
    column = np.array([[1, 2], [1, 3], [2, 2], [0, 0], [2, 1]], dtype=np.uint64)
    np.testing.assert_array_equal(IdIndex(column).rows(column[::-1]), [4, 3, 2, 1, 0])
