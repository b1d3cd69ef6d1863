"""Tables are fitted to the terminal without cutting words or numbers."""

from __future__ import annotations

import io

import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplab_py.console.fitting import GAP, fitted
from maplab_py.console.layout import Table

WORDS = st.text("abcdefgh.0123456789", min_size=1, max_size=12)
TEXTS = st.lists(WORDS, min_size=0, max_size=4).map(" ".join)


def closures() -> Table:
    heads = ["id", "query", "query [s]", "correction [deg]", "verdict", "what to do about it"]
    row = ["a243b811", "61dc0de3", "105.9200", "1.3540", "accepted", "relax first and search again"]
    return Table("closures", heads, [row, row], [False, False, True, True, False, False])


@st.composite
def tables(draw: st.DrawFn) -> Table:
    columns = draw(st.integers(1, 9))
    heads = draw(st.lists(TEXTS, min_size=columns, max_size=columns))
    rows = draw(st.lists(st.lists(TEXTS, min_size=columns, max_size=columns), max_size=3))
    return Table("title", heads, rows, [False] * columns)


@given(tables(), st.integers(31, 120))
def test_every_column_appears_once_and_no_word_is_cut(table: Table, width: int) -> None:
    panels = fitted(table, width)
    shown = [list(panel.table.heads) for panel in panels]
    assert shown[0] + [head for heads in shown[1:] for head in heads[1:]] == table.heads
    for panel in panels:
        assert panel.table.heads[0] == table.heads[0]
        assert [row[0] for row in panel.table.rows] == [row[0] for row in table.rows]
        assert sum(panel.widths) + GAP * len(panel.widths) <= width
        for column, column_width in enumerate(panel.widths):
            texts = [panel.table.heads[column], *(row[column] for row in panel.table.rows)]
            assert all(len(word) <= column_width for text in texts for word in text.split())


def test_a_table_that_fits_is_left_alone() -> None:
    (panel,) = fitted(closures(), 200)
    assert panel.table == closures()
    assert panel.widths == [8, 8, 9, 16, 8, 28]


def test_text_is_folded_before_columns_are_moved() -> None:
    (panel,) = fitted(closures(), 80)
    assert panel.widths[:2] == [8, 8]
    assert panel.widths[-1] < 28


@pytest.mark.parametrize("columns", [40, 80, 150])
def test_numbers_are_whole_on_a_terminal(columns: int) -> None:
    from rich.console import Console

    from maplab_py.console.render import _print_block

    stream = io.StringIO()
    _print_block(closures(), Console(file=stream, width=columns, color_system=None))
    lines = stream.getvalue().splitlines()
    assert max(map(len, lines)) <= columns
    for text in ("a243b811", "61dc0de3", "105.9200", "1.3540", "accepted"):
        assert sum(text in line.split() for line in lines) >= 2, text
