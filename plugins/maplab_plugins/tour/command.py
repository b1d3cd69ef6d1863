"""The command that starts, resumes and ends the tour."""

from __future__ import annotations

from pathlib import Path

from maplab_plugins.tour.guide import NAME, Guide
from maplab_plugins.tour.steps import MAP_KEY, tour_steps
from maplab_py.plugin import CommandContext, Message, UserError, command

_SCENARIO = "three_sessions"
_WELCOME = (
    "Ten minutes at the prompt: you type, the console explains. The recordings are simulated."
)


@command(
    "tour",
    example="tour --folder=maplab_tour",
    needs_map=False,
    acts_outside=True,
    guards_effects=True,
    see_also=("demo", "help"),
)
def tour(
    context: CommandContext,
    *,
    folder: Path = Path("maplab_tour"),
    skip: bool = False,
    stop: bool = False,
) -> Message:
    """Learn the console in ten minutes: steps that are typed, checked and explained.

    `maplab tour` starts the console with it. In a running tour the command repeats the step.

    Args:
        folder: Folder for the recordings and what the tour writes; recordings in it are used again.
        skip: Go on to the next step.
        stop: End the tour.
    """
    guide = context.session.watchers.find(NAME, Guide)
    if guide is not None and stop:
        context.session.watchers.remove(NAME)
        return Message("The tour has ended; `tour` starts it again.")
    if guide is not None and not guide.is_over:
        if skip:
            guide.skip()
        return Message(guide.text())
    if skip or stop:
        raise UserError("tour: it is not running; start it with: tour")
    if not context.terminal.is_prompt:
        raise UserError("tour: somebody has to type; start it in a terminal with: maplab tour")
    context.maps.check_new_key(MAP_KEY)
    _simulate(context, folder / "sessions")
    session = context.session
    guide = Guide(session.registry, session.terminal, tour_steps(folder))
    if not context.is_trial:
        session.watchers.set(NAME, guide)
    return Message(f"{_WELCOME}\n\n{guide.text()}")


def _simulate(context: CommandContext, folder: Path) -> None:
    """Write the recordings unless an earlier tour has done so."""
    from maplab_py.simulation.raw_data import refuse_used_folder, write_maps
    from maplab_py.simulation.scenario_file import load_scenario

    if (folder / "truth.npz").is_file():
        return
    refuse_used_folder(folder, overwrite=False)
    scenario = load_scenario(_SCENARIO)
    write_maps(scenario, folder, raw_data=False, overwrite=False, progress=context.progress)
