"""Distinct values are those of numpy."""

import numpy as np
import pytest

from maplab_py.distinct import distinct


@pytest.mark.parametrize("dtype", [np.int64, np.int32, np.uint8, np.float64, np.bool_, "<U3"])
def test_distinct_values_are_those_of_numpy(dtype: object) -> None:
    values = np.random.default_rng(0).integers(0, 50, (20, 10)).astype(dtype)
    result = distinct(values)
    assert result.dtype == values.dtype
    assert np.array_equal(result, np.unique(values))


def test_nothing_has_no_distinct_values() -> None:
    assert len(distinct(np.zeros(0, dtype=np.int64))) == 0


def test_the_array_is_left_as_it_is() -> None:
    values = np.array([3, 1, 3])
    assert distinct(values).tolist() == [1, 3]
    assert values.tolist() == [3, 1, 3]
