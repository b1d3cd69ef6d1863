"""Ctrl-C in commands of every kind, on a recorded map: the prompt is back, nothing has changed.

All commands: `python -m benchmarks.interruptions`.
"""

from collections.abc import Iterator

import pytest

from tests.support import data, machine
from tests.support.interruptions import Interrupter, Workspace

pytestmark = pytest.mark.slow

PROMPT_S = 1.0
NAMES = (
    "csv_export",  # several files
    "landmark_sparsify",
    "load",
    "loopclosure_all_missions",
    "optimize_visual_inertial",
    "plot_trajectory",  # imports a heavy library
    "save",
    "simulate",
    "stereo_dense_reconstruction",
    "train_projection_matrix",
    "visualize",
)


@pytest.fixture(scope="module")
def interrupter(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Interrupter]:
    tango = data.shared_data("maplab_maps/tango_handheld")
    console = Interrupter(Workspace(tmp_path_factory.mktemp("interruptions"), tango))
    yield console
    console.close()


@pytest.mark.parametrize("name", NAMES)
def test_the_prompt_is_back_and_nothing_has_changed(interrupter: Interrupter, name: str) -> None:
    presses = interrupter.interrupt(name, at_most_s=3.0, shares=(0.4, 0.8))
    assert [press for press in presses if press.harm] == []
    assert {press.outcome for press in presses} <= {"cancelled", "done"}
    # other work on the machine may hold one of them up: the second slowest counts
    assert sorted(press.prompt_s for press in presses)[-2] <= PROMPT_S * machine.slowness(), presses
