"""Rows: dataclasses of arrays that share their first axis."""

import dataclasses

import numpy as np

from maplab_py.array_types import F64, I64, Rows


class Marks(Rows):
    source: str
    time_ns: I64
    place: F64
    weight: F64 | None = None


def test_rows_are_taken_and_joined():
    marks = Marks("a", np.array([3, 1, 2]), np.arange(6.0).reshape(3, 2))
    some = marks.take(marks.time_ns > 1)
    assert (len(marks), len(some), some.source, some.weight) == (3, 2, "a", None)
    assert some.place.tolist() == [[0.0, 1.0], [4.0, 5.0]]
    assert marks.take(slice(1)).time_ns.tolist() == [3]
    both = Marks.concatenate([some, dataclasses.replace(marks, source="b")])
    assert both.time_ns.tolist() == [3, 2, 3, 1, 2]
    assert (both.source, both.weight, both.place.shape) == ("a", None, (5, 2))
