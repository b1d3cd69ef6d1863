"""Searches that are repeated give the result of the first, without an index."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from maplab_py.algorithms.loop_closure import matching
from maplab_py.algorithms.loop_closure.matching import SearchMemory, nearest_rows
from maplab_py.array_types import I32
from maplab_py.vision.descriptors import pack_words
from maplab_py.vision.index import DescriptorSet, MatchRule
from maplab_py.vision.multi_index import InvertedMultiIndex
from maplab_py.vision.projection import learn_projection

ANY = MatchRule()
OTHERS = MatchRule(other_sessions_only=True)


@pytest.fixture(scope="module")
def descriptors() -> DescriptorSet:
    label = np.repeat(np.arange(60), 4)
    raw = np.random.default_rng(3).integers(0, 256, (60, 16), dtype=np.uint8)[label]
    raw[:, 0] ^= np.random.default_rng(4).integers(0, 8, len(raw), dtype=np.uint8)
    return DescriptorSet(
        projected=learn_projection(raw, label, dimensions=4).project(raw),
        words=pack_words(raw),
        label=label,
        session=(np.arange(len(label)) % 3).astype(np.int32),
        time_ns=np.arange(len(label), dtype=np.int64) * 10**9,
    )


class _Counted:
    """Counts how many indices are built."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.built = 0
        monkeypatch.setattr(matching, "InvertedMultiIndex", self)

    def __call__(self, database: DescriptorSet, **settings: Any) -> InvertedMultiIndex:
        self.built += 1
        return InvertedMultiIndex(database, **settings)


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> _Counted:
    return _Counted(monkeypatch)


def _search(
    memory: SearchMemory,
    database: DescriptorSet,
    queries: DescriptorSet,
    rules: list[MatchRule],
    k: int = 2,
    max_difference: float = np.inf,
) -> list[I32]:
    return nearest_rows(
        database,
        queries,
        k,
        rules,
        seed=0,
        words_per_query=4,
        max_difference=max_difference,
        memory=memory,
    )


def test_the_result_is_that_of_the_index(descriptors: DescriptorSet) -> None:
    index = InvertedMultiIndex(descriptors, cells_per_query=4)
    memory = SearchMemory()
    for _ in range(2):
        results = _search(memory, descriptors, descriptors, [ANY, OTHERS])
        for rows, rule in zip(results, (ANY, OTHERS), strict=True):
            np.testing.assert_array_equal(rows, index.nearest(descriptors, 2, rule).row)
    assert len(memory) == 2


def test_equal_searches_build_one_index(descriptors: DescriptorSet, counted: _Counted) -> None:
    memory = SearchMemory()
    everything = np.arange(len(descriptors))
    first = _search(memory, descriptors, descriptors, [ANY])
    again = _search(memory, descriptors.take(everything), descriptors.take(everything), [ANY])
    assert counted.built == 1
    assert again[0] is first[0]
    with pytest.raises(ValueError, match="read-only"):
        first[0][0, 0] = 5
    _search(memory, descriptors, descriptors, [ANY, OTHERS])  # one of the two is new
    assert counted.built == 2
    assert len(memory) == 2


@pytest.mark.parametrize("column", ["projected", "words", "label", "session", "time_ns"])
def test_any_change_is_searched(descriptors: DescriptorSet, counted: _Counted, column: str) -> None:
    memory = SearchMemory()
    _search(memory, descriptors, descriptors, [ANY])
    values = np.array(getattr(descriptors, column))
    values[-1] += 1
    changed = dataclasses.replace(descriptors, **{column: values})
    _search(memory, changed, descriptors, [ANY])
    _search(memory, descriptors, changed, [ANY])
    _search(memory, descriptors, descriptors, [ANY], k=3)
    _search(memory, descriptors, descriptors, [ANY], max_difference=20.0)
    _search(memory, descriptors, descriptors, [MatchRule(10**9)])
    assert counted.built == 6
    assert len(memory) == 6


def test_the_oldest_results_are_dropped(descriptors: DescriptorSet, counted: _Counted) -> None:
    size = _search(SearchMemory(), descriptors, descriptors, [ANY])[0].nbytes
    memory = SearchMemory(max_bytes=2 * size)
    for rule in (ANY, OTHERS, ANY, MatchRule(10**9)):  # ANY is used again, so OTHERS is oldest
        _search(memory, descriptors, descriptors, [rule])
    assert len(memory) == 2
    counted.built = 0
    _search(memory, descriptors, descriptors, [ANY])
    assert counted.built == 0
    _search(memory, descriptors, descriptors, [OTHERS])
    assert counted.built == 1


def test_a_result_larger_than_the_memory_is_returned(descriptors: DescriptorSet) -> None:
    memory = SearchMemory(max_bytes=8)
    rows = _search(memory, descriptors, descriptors, [ANY])[0]
    assert rows.shape == (len(descriptors), 2)
    assert len(memory) == 0
