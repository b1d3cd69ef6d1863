"""Functions are called for all values, with and without threads."""

from __future__ import annotations

import threading

import pytest

from maplab_py.storage.checksums import map_in_threads


def test_results_are_in_the_order_of_the_values() -> None:
    assert map_in_threads(pow, range(50), [2] * 50) == [n**2 for n in range(50)]


def test_without_threads_the_results_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", refuse)
    assert map_in_threads(str, range(3)) == ["0", "1", "2"]


def test_errors_of_the_function_reach_the_caller() -> None:
    with pytest.raises(ZeroDivisionError):
        map_in_threads(lambda n: 1 // n, [1, 0])
