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
