"""Matching of time stamps against an exhaustive search."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplab_py.geometry.association import nearest_rows
from tests.support.association import associate

stamps = st.lists(st.integers(0, 60), max_size=12, unique=True).map(sorted).map(np.array)


def exhaustive(a: np.ndarray, b: np.ndarray, tolerance: int) -> list[tuple[int, int]]:
    b_is_longer = len(b) > len(a)
    short, long = (a, b) if b_is_longer else (b, a)
    pairs = []
    for i, time in enumerate(short):
        difference = np.abs(long - time)
        j = int(np.argmin(difference))
        if difference[j] <= tolerance:
            pairs.append((i, j) if b_is_longer else (j, i))
    return pairs


@given(stamps, stamps, st.integers(0, 10))
def test_evos_definition(a: np.ndarray, b: np.ndarray, tolerance: int) -> None:
    i, j = associate(a, b, tolerance, one_to_one=False)
    assert list(zip(i.tolist(), j.tolist(), strict=True)) == exhaustive(a, b, tolerance)


@given(stamps, stamps, st.integers(0, 10))
def test_one_to_one(a: np.ndarray, b: np.ndarray, tolerance: int) -> None:
    i, j = associate(a, b, tolerance)
    assert len(set(i.tolist())) == len(set(j.tolist())) == len(i)
    assert np.all(np.abs(a[i] - b[j]) <= tolerance) if len(i) else True
    loose = exhaustive(a, b, tolerance)
    assert set(zip(i.tolist(), j.tolist(), strict=True)) <= set(loose)
    longer = [pair[1] if len(b) > len(a) else pair[0] for pair in loose]
    assert len(i) == len(set(longer))


def test_the_nearest_partner_wins() -> None:
    i, j = associate([0, 10, 20, 1000], [8, 11, 500], 5)
    assert (i.tolist(), j.tolist()) == ([1], [1])
    i, j = associate([0, 10, 20, 1000], [8, 11, 500], 5, one_to_one=False)
    assert (i.tolist(), j.tolist()) == ([1, 1], [0, 1])


def test_nanoseconds_are_not_rounded() -> None:
    base = 1403715273262142976
    i, _ = associate(base + np.array([0, 100, 200]), base + np.array([101]), 1)
    assert i.tolist() == [1]


@pytest.mark.parametrize(("a", "b"), [([], []), ([1], []), ([], [1, 2])])
def test_empty_lists(a: list[int], b: list[int]) -> None:
    i, j = associate(np.array(a, dtype=np.int64), np.array(b, dtype=np.int64), 5)
    assert (len(i), len(j)) == (0, 0)


def test_nearest_rows_of_one_stamp() -> None:
    assert nearest_rows([5], [1, 5, 9]).tolist() == [0, 0, 0]
    assert nearest_rows([0, 10], [5, 6, -3, 40]).tolist() == [0, 1, 0, 1]
