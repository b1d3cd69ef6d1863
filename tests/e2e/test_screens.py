"""What a person sees in a narrow terminal: whole words, one table per thing, names."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from maplab_py.storage.native import save_map
from tests.e2e import support
from tests.e2e.support import Console
from tests.vimap.builders import walk_map

LINES = (
    "map_stats",
    "map_stats --map_mission=mon",
    "list",
    "help lc_report",
    "check_map_consistency",
    "why mon",
    "history",
)


@pytest.fixture
def console(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Console]:
    monkeypatch.setattr(support, "COLUMNS", request.param)
    monkeypatch.setattr(support, "ROWS", 200)
    save_map(walk_map(), tmp_path / "monday_morning")
    console = Console(tmp_path)
    console.wait_for_prompt()
    yield console
    console.close()


@pytest.mark.parametrize("console", [80], indirect=True)
def test_screens(console: Console) -> None:
    console.enter("load monday_morning")
    console.wait_for_prompt("maplab <monday_morning>:/$")
    assert "map 'monday_morning': 1 mission, " in console.text
    for line in LINES:
        console.enter(line)
        console.wait_for_prompt("maplab <monday_morning>:/$")
    text = console.text
    row = next(line.split() for line in text.splitlines() if line.startswith("monday_morning "))
    assert row[0] == "monday_morning"
    assert row[-1] in ("yes", "no")
    head = next(line.split() for line in text.splitlines() if line.startswith("mission  "))
    assert head[:2] == ["mission", "id"]
    assert "\nmissions\n" not in text
    assert "the map is consistent: no rule is violated" in text
    assert "--descending  bool, default false" in text  # its text has no room beside it
    assert "no room for" not in text
    assert "The map has no other mission." in text
    assert "--map_folder=" in text.rpartition("history:")[0]


@pytest.mark.parametrize("console", [100], indirect=True)
def test_completion_and_redirection_at_the_prompt(console: Console, tmp_path: Path) -> None:
    console.enter("load monday_morning")
    console.wait_for_prompt("maplab <monday_morning>:/$")
    console.type("sbk --map_mission=mon\t")
    console.wait_for_text("--map_mission=monday_morning")
    console.type("\x03")
    console.enter("map_stats > counts.txt")
    console.wait_for_prompt("maplab <monday_morning>:/$")
    assert "monday_morning" in (tmp_path / "counts.txt").read_text()
    console.type("ovi\t")
    screen = console.wait_for_text("optimize_visual_inertial")
    menu = [line.split()[0] for line in screen.splitlines() if " Optimise poses" in line]
    assert menu[0] == "optvi"
