"""Reports at several widths: what a person reads on one screen."""

from __future__ import annotations

import dataclasses

import pytest

from maplab_py.console.terminal.drawing import drawn
from maplab_py.console.terminal.layout import blocks_of
from maplab_py.console.terminal.naming import names_by_id, text_with_names, with_names
from maplab_py.report import Message, Report


@dataclasses.dataclass(frozen=True)
class FlagLine:
    flag: str
    type: str
    default: str
    unit: str
    help: str


@dataclasses.dataclass(frozen=True)
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


@dataclasses.dataclass(frozen=True)
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


@dataclasses.dataclass(frozen=True)
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


@dataclasses.dataclass(frozen=True)
class Short(Report):
    count: int

    def display(self) -> Message:
        return Message(f"{self.count} maps")


def test_what_is_displayed_can_be_a_sentence_and_json_has_the_fields() -> None:
    assert shown(Short(2), 80) == "2 maps"
    assert Short(2).as_dict() == {"count": 2}


@dataclasses.dataclass(frozen=True)
class Untitled(Report):
    flags: tuple[FlagLine, ...] = dataclasses.field(metadata={"title": ""})


@dataclasses.dataclass(frozen=True)
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


@dataclasses.dataclass(frozen=True)
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


@dataclasses.dataclass(frozen=True)
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


@dataclasses.dataclass(frozen=True)
class Units(Report):
    seconds: float
    megabytes: float
    chi_square_per_freedom: float
    ids: tuple[str, ...]


def test_quantities_have_names_and_ids_stand_in_one_line() -> None:
    text = shown(Units(1.0, 2.0, 1.0, tuple(f"{n:08x}" for n in range(11))), 200)
    heads = [line.partition("  ")[0] for line in text.splitlines()]
    assert heads == ["time [s]", "size [MB]", "chi square per degree of freedom", "ids"]


def test_help_never_leaves_out_the_text_of_a_flag() -> None:
    long = FlagLine(
        "--" + "f" * 50, "step_quality|ceres|levenberg_marquardt|dogleg|other", "1", "", "x y " * 30
    )
    text = shown(Page("optvi", (*PAGE.flags, long)), 100)
    assert "no room for" not in text
    assert "\n    Least number of inliers of a closure\n" in text
