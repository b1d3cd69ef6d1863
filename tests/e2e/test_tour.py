"""The tour from its first to its last step, in a pseudo-terminal."""

from pathlib import Path

import pytest
from maplab_plugins.tour import tour_steps

from tests.e2e.support import Console, run_program


def test_it_says_how_to_start_it_where_nobody_types(tmp_path: Path) -> None:
    result = run_program(tmp_path, "tour")
    assert result.returncode == 2
    assert "start it in a terminal with: maplab tour" in result.stderr


@pytest.mark.slow
def test_every_step_leads_to_the_next(tmp_path: Path) -> None:
    steps = tour_steps(Path("maplab_tour"))
    console = Console(tmp_path, "tour")
    try:
        for number, step in enumerate(steps, start=1):
            heading = f"Step {number} of {len(steps)}: {step.title}"
            console.wait_for(lambda screen, heading=heading: heading in screen, 400.0)
            console.wait_for(lambda _: console.last_line.endswith("$"), 60.0)
            if number == 2:
                console.enter("map_stat --nonsense")
                console.wait_for_text("that did not work")
                console.wait_for(lambda _: console.last_line.endswith("$"), 60.0)
            console.enter(step.line)
        console.wait_for(lambda screen: "The tour is over" in screen, 400.0)
        console.enter("quit")
        assert console.status() == 0
    finally:
        console.close()
    folder = tmp_path / "maplab_tour"
    assert (folder / "office").is_dir()
    assert (folder / "path_lengths" / "pyproject.toml").is_file()
