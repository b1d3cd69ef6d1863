"""Figures over releases: which changes are regressions, and the table of the page."""

import json
import sys
from pathlib import Path

import pytest

from benchmarks import kpi
from benchmarks.kpi import PAGE, Change, regressions, stored_releases, table, write_page


@pytest.mark.parametrize(
    ("name", "before", "now", "is_regression"),
    [
        ("walk_ate_m", 1.0, 1.09, False),
        ("walk_ate_m", 1.0, 1.11, True),
        ("solver_ratio", 1.0, 1.14, False),
        ("solver_ratio", 1.0, 1.16, True),
        ("failed_share", 0.0, 0.0, False),
        ("failed_share", 0.0, 0.1, True),
        ("solver_ratio", 1.0, 0.5, False),
    ],
)
def test_accuracy_may_lose_a_tenth_and_ratios_15_percent(
    name: str, before: float, now: float, is_regression: bool
) -> None:
    assert Change(name, before, now).is_regression == is_regression


def test_the_last_two_releases_are_compared_by_their_numbers(tmp_path: Path) -> None:
    for release, value in (("0.9.0", 1.0), ("0.10.0", 2.0), ("0.2.0", 5.0)):
        (tmp_path / f"{release}.json").write_text(json.dumps({"a_m": value, "only": value}))
    releases = stored_releases(tmp_path)
    assert [name for name, _ in releases] == ["0.2.0", "0.9.0", "0.10.0"]
    assert regressions(releases)[0] == "a_m: 1 in 0.9.0, 2 in 0.10.0 (+100 %)"
    assert regressions(releases[:1]) == []
    assert "| a m | 5 | 1 | 2 | +100 % |" in table(releases)


@pytest.mark.parametrize("text", ["[1]", "{", '{"a": "b"}', '{"a": null}'])
def test_a_file_that_is_no_table_of_numbers_is_named(tmp_path: Path, text: str) -> None:
    (tmp_path / "1.0.json").write_text(text)
    with pytest.raises(ValueError, match=r"1\.0\.json: no JSON object of numbers"):
        stored_releases(tmp_path)


def test_the_page_has_the_table_of_the_stored_figures(tmp_path: Path) -> None:
    copy = tmp_path / "benchmarks.md"
    copy.write_text(PAGE.read_text("utf-8"), encoding="utf-8")
    write_page(stored_releases(), copy)
    assert copy.read_text("utf-8") == PAGE.read_text("utf-8")


def test_a_worsening_is_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now = {"walk_ate_m": 0.012, "solver_ratio": 0.1}
    (tmp_path / "0.1.0.json").write_text(json.dumps({"walk_ate_m": 0.01, "solver_ratio": 0.1}))
    (tmp_path / "0.2.0.json").write_text(json.dumps(now))
    monkeypatch.setattr(kpi, "STORED", tmp_path)
    monkeypatch.setattr(sys, "argv", ["kpi", "--compare"])
    kpi.main()
    assert capsys.readouterr().out == "worse: walk_ate_m: 0.01 in 0.1.0, 0.012 in 0.2.0 (+20 %)\n"
