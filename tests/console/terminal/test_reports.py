"""Reports as text: columns that fit, layout, numbers."""

import dataclasses
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplab_py.console.terminal.drawing import GAP, drawn, fitted
from maplab_py.console.terminal.layout import Pairs, Table, blocks_of, format_column
from maplab_py.console.terminal.render import names_by_id, text_with_names, with_links, with_names
from maplab_py.report import Message, Report

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


@dataclasses.dataclass(frozen=True)
class Row:
    note: str


class Sample(Report):
    T_G_M_known: bool = True
    p_G_z_m: float = 1.0
    IMU_rate: int = 200
    seconds_build: float = 0.5
    seconds_per_segment: float = 0.25
    total_s: float = 2.0
    process_gb: float = 0.5
    none_of_these: dict[str, int] = dataclasses.field(default_factory=dict)
    no_rows: tuple[Row, ...] = ()
    empty_rows: tuple[Row, ...] = (Row(""), Row(""))


def test_headings_keep_names_of_transformations_and_give_units() -> None:
    (pairs,) = blocks_of(Sample())
    assert isinstance(pairs, Pairs)
    assert [name for name, _ in pairs.rows] == [
        "T_G_M known",
        "p_G z [m]",
        "IMU rate",
        "build time [s]",
        "time per segment [s]",
        "total [s]",
        "process [GB]",
    ]


def test_what_is_empty_has_no_heading() -> None:
    blocks = blocks_of(dataclasses.replace(Sample(), none_of_these={"a": 1}))
    assert [getattr(block, "title", "") for block in blocks] == ["", "none of these"]


@dataclasses.dataclass(frozen=True)
class FlagLine:
    flag: str
    type: str
    default: str
    unit: str
    help: str


class Page(Report):
    command: str
    flags: tuple[FlagLine, ...] = dataclasses.field(metadata={"are_entries": True})


PAGE = Page(
    "relax",
    (
        FlagLine("--lc_min_inlier_count", "int", "10", "", "Least number of inliers of a closure"),
        FlagLine(
            "--lc_ransac_pixel_sigma",
            "float",
            "2",
            "px",
            "Standard deviation of a keypoint; matches within three of them are inliers",
        ),
    ),
)

NARROW = """\
command  relax

flags
--lc_min_inlier_count  int, default 10
    Least number of inliers of a closure
--lc_ransac_pixel_sigma  float, default 2, unit px
    Standard deviation of a keypoint; matches within three
    of them are inliers"""

WIDE = """\
command  relax

flags
flag                     type   default  unit  help
───────────────────────  ─────  ───────  ────  ─────────────────────────────────────────────────────
--lc_min_inlier_count    int    10             Least number of inliers of a closure
--lc_ransac_pixel_sigma  float  2        px    Standard deviation of a keypoint; matches within
                                               three of them are inliers"""


def shown(report: Report, width: int) -> str:
    return "\n\n".join(drawn(block, width, coloured=False) for block in blocks_of(report))


@pytest.mark.parametrize(("width", "text"), [(60, NARROW), (100, WIDE)])
def test_help_puts_the_text_of_a_flag_under_it_where_the_terminal_is_narrow(
    width: int, text: str
) -> None:
    assert shown(PAGE, width) == text


def test_colours_do_not_change_the_layout() -> None:
    for width in (60, 100):
        coloured = "\n\n".join(drawn(block, width, coloured=True) for block in blocks_of(PAGE))
        for code in ("\x1b[1m", "\x1b[1;36m", "\x1b[36m", "\x1b[2m", "\x1b[0m"):
            coloured = coloured.replace(code, "")
        assert coloured == shown(PAGE, width)


class Joined(Report):
    mission: str
    pairs: tuple[str, ...]
    counts: dict[str, int]


IDS = ("61dc0de35a3bc9150b00000000000000", "59f0a1b2000000000000000000000000")


def test_missions_are_shown_by_name_wherever_their_id_stands() -> None:
    names = names_by_id([(IDS[0], "monday"), (IDS[1], "tuesday")])
    report = Joined(IDS[0], ("61dc0de3 - 59f0a1b2: 12 closures " * 3,), {"59f0a1b2": 4})
    blocks = with_names(blocks_of(report), names)
    text = "\n".join(drawn(block, 200, coloured=False) for block in blocks)
    assert "61dc" not in text
    assert "59f0" not in text
    assert "monday - tuesday: 12 closures" in text
    assert text_with_names("x61dc0de3 61dc0de", names) == "x61dc0de3 61dc0de"


class Identified(Report):
    id: str
    mission: str


def test_the_id_of_a_mission_itself_stays() -> None:
    names = names_by_id([(IDS[0], "monday")])
    blocks = with_names(blocks_of(Identified(IDS[0], IDS[0])), names)
    assert drawn(blocks[0], 80, coloured=False).splitlines() == [
        f"id       {IDS[0]}",
        "mission  monday",
    ]


def test_a_short_id_of_two_missions_stays() -> None:
    names = names_by_id([(IDS[0], "monday"), (IDS[0][:-1] + "1", "tuesday")])
    assert text_with_names("61dc0de3", names) == "61dc0de3"
    assert text_with_names(IDS[0], names) == "monday"


class Short(Report):
    count: int

    def display(self) -> Message:
        return Message(f"{self.count} maps")


def test_what_is_displayed_can_be_a_sentence_and_json_has_the_fields() -> None:
    assert shown(Short(2), 80) == "2 maps"
    assert Short(2).as_dict() == {"count": 2}


class Untitled(Report):
    flags: tuple[FlagLine, ...] = dataclasses.field(metadata={"title": ""})


class Several(Report):
    reports: dict[str, Report]


def test_a_nested_report_without_a_title_of_its_own_gets_its_key() -> None:
    text = shown(Several({"[1] list": Untitled(PAGE.flags)}), 160)
    assert text.startswith("[1] list\nflag ")


@dataclasses.dataclass(frozen=True)
class Spread:
    median: float
    largest: float
    count: int = 1

    @property
    def is_empty(self) -> bool:
        return self.count == 0


class Spreads(Report):
    queries: int
    position_m: Spread
    rotation_deg: Spread
    time_ms: Spread


COLUMNS = """\
queries  7

         position [m]  rotation [deg]
-------  ------------  --------------
median         0.0100            1.50
largest        0.2500           12.25
count               1               1"""


def test_records_of_one_kind_are_the_columns_of_one_table() -> None:
    report = Spreads(7, Spread(0.01, 0.25), Spread(1.5, 12.25), Spread(0.0, 0.0, count=0))
    assert shown(report, 80).replace("─", "-") == COLUMNS


def test_a_table_of_empty_records_is_left_out() -> None:
    nothing = Spread(0.0, 0.0, count=0)
    assert shown(Spreads(7, nothing, nothing, nothing), 80) == "queries  7"


class Script(Report):
    line: str

    @property
    def is_verbatim(self) -> bool:
        return True

    def as_text(self) -> str:
        return self.line


def test_a_script_is_not_folded_and_a_note_keeps_its_indentation() -> None:
    line = "optvi " + "--ba_num_iterations=20 " * 8
    assert shown(Script(line), 60) == line
    (first, *others) = shown(Message(f"notes:\n  {line}"), 60).splitlines()[1:]
    assert [text[:3] for text in (first, *others)] == ["  o", *["  -" for _ in others]]
    assert others


def test_rounding_noise_is_zero_and_has_no_sign() -> None:
    text = shown(Spreads(1, *(Spread(-3e-17, 2e-15) for _ in range(3))), 80)
    assert "e-1" not in text
    assert "-0" not in text


def test_help_never_leaves_out_the_text_of_a_flag() -> None:
    long = FlagLine(
        "--" + "f" * 50, "step_quality|ceres|levenberg_marquardt|dogleg|other", "1", "", "x y " * 30
    )
    text = shown(Page("optvi", (*PAGE.flags, long)), 100)
    assert "no room for" not in text
    assert "\n    Least number of inliers of a closure\n" in text


@dataclasses.dataclass(frozen=True)
class Measured:
    value: float = dataclasses.field(metadata={"deviation": "sigma"})
    sigma: float = dataclasses.field(metadata={"deviation": "sigma"})
    ratio: float = dataclasses.field(metadata={"deviation": 1.0})


class Measurements(Report):
    values: tuple[Measured, ...]


def test_numbers_are_printed_as_far_as_their_deviations_say() -> None:
    rows = [
        (461.4417, 0.7612, 3.66),
        (0.00026, 3.2e-6, 0.0),
        (1234.5, 17.0, -9.81),
        (1.5, 0.0, 0.0),
    ]
    [table] = blocks_of(Measurements(tuple(Measured(*row) for row in rows)))
    assert isinstance(table, Table)
    assert table.is_number == [True, True, True]
    assert table.rows[:3] == [
        ["461.44", "0.76", "3.7"],
        ["0.0002600", "0.0000032", "0.0"],
        ["1234", "17", "-9.8"],
    ]
    assert table.rows[3][0] == "1.5000"  # nothing is known about it


def test_ids_become_links_to_the_page_of_the_viewer() -> None:
    text = with_links("a243b811 20261126 of deadbeef, face", "http://127.0.0.1:8080")
    assert re.sub("\x1b]8;;[^\x1b]*\x1b\\\\", "", text) == "a243b811 20261126 of deadbeef, face"
    assert re.findall("\x1b]8;;([^\x1b]+)\x1b", text) == [
        "http://127.0.0.1:8080/go/a243b811",
        "http://127.0.0.1:8080/go/deadbeef",
    ]


def test_decorated_reports_of_plugins_are_the_same_dataclasses() -> None:
    @dataclasses.dataclass(frozen=True)
    class Decorated(Report):
        count: int
        note: str = "none"
        rows: list[int] = dataclasses.field(default_factory=list)

    @dataclasses.dataclass(frozen=True)
    class Longer(Decorated):
        """A report of a report that has a value made anew for each."""

        is_longer: bool = True

    assert Decorated(3).as_dict() == {"count": 3, "note": "none", "rows": []}
    assert Longer(3).as_dict() == {"count": 3, "note": "none", "rows": [], "is_longer": True}
    assert Decorated(3) == Decorated(3, "none", [])
    with pytest.raises(dataclasses.FrozenInstanceError):
        Decorated(3).count = 4  # type: ignore[misc]
