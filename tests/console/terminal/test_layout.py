"""Reports as people read them: headings with units, no heading without content."""

from __future__ import annotations

import dataclasses

from maplab_py.console.terminal.layout import Pairs, blocks_of
from maplab_py.report import Report, counted


@dataclasses.dataclass(frozen=True)
class Row:
    note: str


@dataclasses.dataclass(frozen=True)
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


def test_nouns_follow_their_numbers() -> None:
    assert counted(1, "map") == "1 map"
    assert counted(0, "map") == "0 maps"
    assert counted(2, "vertex", "vertices") == "2 vertices"
