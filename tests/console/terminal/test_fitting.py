"""Tables are fitted to the terminal without cutting words or numbers."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplab_py.console.terminal.drawing import GAP, drawn, fitted
from maplab_py.console.terminal.layout import Table, format_column

WORDS = st.text("abcdefgh.0123456789", min_size=1, max_size=12)
TEXTS = st.lists(WORDS, min_size=0, max_size=4).map(" ".join)


def closures(rows: int = 2) -> Table:
    heads = ["id", "query", "query [s]", "correction [deg]", "verdict", "what to do about it"]
    row = ["a243b811", "61dc0de3", "105.9200", "1.3540", "accepted", "relax first and search again"]
    return Table("closures", heads, [row] * rows, [False, False, True, True, False, False])


@st.composite
def tables(draw: st.DrawFn) -> Table:
    columns = draw(st.integers(1, 9))
    heads = draw(st.lists(TEXTS, min_size=columns, max_size=columns))
    rows = draw(st.lists(st.lists(TEXTS, min_size=columns, max_size=columns), max_size=7))
    return Table("title", heads, rows, [False] * columns)


@given(tables(), st.integers(31, 120))
def test_no_word_is_cut_and_every_column_is_shown_or_named(table: Table, width: int) -> None:
    shown = fitted(table, width)
    assert sum(shown.widths) + GAP * (len(shown.widths) - 1) <= width
    for column, column_width in enumerate(shown.widths):
        texts = [shown.table.heads[column], *(row[column] for row in shown.table.rows)]
        assert all(len(word) <= column_width for text in texts for word in text.split())
    if shown.table.heads + shown.omitted != table.heads:  # transposed
        assert shown.table.heads == [table.heads[0], *(row[0] for row in table.rows)]
        assert [row[0] for row in shown.table.rows] == table.heads[1:]
        assert shown.omitted == []


def test_a_table_that_fits_is_left_alone() -> None:
    shown = fitted(closures(), 200)
    assert shown.table == closures()
    assert shown.widths == [8, 8, 9, 16, 8, 28]
    assert shown.omitted == []


def test_text_is_folded_before_columns_are_left_out() -> None:
    shown = fitted(closures(9), 80)
    assert shown.widths[:2] == [8, 8]
    assert shown.widths[-1] < 28
    assert shown.omitted == []


def test_a_table_of_few_rows_is_transposed_before_columns_are_left_out() -> None:
    shown = fitted(closures(2), 40)
    assert shown.table.heads == ["id", "a243b811", "a243b811"]
    assert shown.omitted == []


def test_a_table_of_many_rows_names_the_columns_that_have_no_room() -> None:
    text = drawn(closures(9), 40, coloured=False)
    assert "no room for: " in text
    assert "what to do about it" in " ".join(text.split())


@pytest.mark.parametrize("columns", [40, 80, 150])
def test_numbers_are_whole_on_a_terminal(columns: int) -> None:
    lines = drawn(closures(), columns, coloured=False).splitlines()
    assert max(map(len, lines)) <= columns
    for text in ("a243b811", "61dc0de3", "105.9200", "1.3540", "accepted"):
        assert sum(line.split().count(text) for line in lines) >= 2, text


@pytest.mark.parametrize(
    ("values", "cells"),
    [
        ([120.3, 0.0123], ["120.300", "0.012"]),
        ([117.88, 0.0], ["117.9", "0.0"]),
        ([1.0, None, float("nan")], ["1.000", "-", "-"]),
        ([1e-7, 3e-7], ["1.000e-07", "3.000e-07"]),
        ([3.5e-14, 0.0, None], ["0.0000", "0.0000", "-"]),
        ([1.831e6, 205.62, 21558.22], ["1831000", "206", "21558"]),
        ([2.5e12, 1.0], ["2.500e+12", "1.000e+00"]),
        ([5, 6.25], ["5", "6.250"]),
        ([123456.0, 2.0], ["123456.00", "2.00"]),
        (["", "text"], ["", "text"]),
    ],
)
def test_numbers_of_a_column_share_their_decimals(values: list[object], cells: list[str]) -> None:
    assert format_column(values) == cells
