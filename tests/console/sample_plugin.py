"""A plugin as a stranger would write it, and small maps, for tests of the console."""

import dataclasses
import sys
from enum import Enum
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np

from maplab_py.console.commands.registry import Plugin, Registry
from maplab_py.console.session.session import Session
from maplab_py.plugin import (
    CommandContext,
    EstimationError,
    Message,
    Report,
    UserError,
    command,
    option,
    write_text,
)
from maplab_py.vimap import BaseFrames, Missions, VIMap


class Colour(Enum):
    """Values of a choice."""

    RED = "r"
    DEEP_BLUE = "b"


@dataclasses.dataclass(frozen=True)
class InnerOptions:
    """Options inside options."""

    flag_prefix: ClassVar[str] = "inner_"
    depth: int = option(2, help="How deep.")


@dataclasses.dataclass(frozen=True)
class SolverOptions:
    """Options of a pretended solver."""

    flag_prefix: ClassVar[str] = "ba_"
    num_iterations: int = option(10, help="Most iterations.")
    tolerance_m: float = option(1e-3, help="When to stop.", unit="m")
    loss: str = option("huber", help="Robust loss.", choices=("huber", "cauchy", "none"))
    fix_gravity: bool = option(True, help="Keep gravity.", flag="fix_gravity")
    inner: InnerOptions = dataclasses.field(default_factory=InnerOptions)

    def __post_init__(self) -> None:
        if self.num_iterations < 0:
            raise ValueError("--ba_num_iterations cannot be negative")


class SolveReport(Report):
    """What the pretended solver was told."""

    options: SolverOptions
    name: str
    colour: Colour
    mode: str
    limit: float | None
    folder: Path | None
    factors: tuple[float, ...]


@command("solve", "s", "slv", example="solve --ba_loss=none", needs_map=False)
def solve(
    context: CommandContext,
    name: str = "",
    *,
    options: SolverOptions = SolverOptions(),
    colour: Colour = Colour.RED,
    mode: Literal["fast", "exact"] = "fast",
    limit: float | None = None,
    folder: Path | None = None,
    factors: tuple[float, ...] = (),
) -> SolveReport:
    """Pretend to solve.

    More words about it.

    Args:
        name: A name,
            described on two lines.
        limit: An upper limit.
    """
    return SolveReport(options, name, colour, mode, limit, folder, factors)


@command("add_mission")
def add_mission(context: CommandContext) -> Message:
    """Add a mission to the selected map."""
    context.commit(map_of(len(context.vi_map.missions) + 1))
    return Message(f"{len(context.vi_map.missions)} missions")


@command("fail_after_commit")
def fail_after_commit(context: CommandContext, *, how: str = "user") -> Message:
    """Commit a draft, add a map, then fail."""
    context.commit(map_of(99))
    context.maps.add("leftover", VIMap())
    errors = {
        "user": UserError("you did it"),
        "estimation": EstimationError("it diverged"),
        "program": ZeroDivisionError("a bug"),
    }
    raise errors[how]


class Refusal(Report):
    """A report of a failure."""

    count: int

    @property
    def failure(self) -> str:
        return "nothing was found"


@command("find_nothing", needs_map=False)
def find_nothing(context: CommandContext) -> Refusal:
    """Report a failure."""
    return Refusal(0)


@command("echo", needs_map=False)
def echo(context: CommandContext, *words: str) -> Message:
    """Print words."""
    return Message(" ".join(words))


@command("keep_words", needs_map=False, writes_files=True)
def keep_words(
    context: CommandContext, file: Path, *words: str, overwrite: bool = False
) -> Message:
    """Write words to a file."""
    write_text(file, words, overwrite=overwrite)
    return Message("kept")


@command("destroy", needs_map=False)
def destroy(context: CommandContext, *, yes: bool = False) -> Message:
    """Ask first."""
    context.confirm("destroy it?", yes=yes)
    return Message("destroyed")


def map_of(missions: int) -> VIMap:
    """Make a map of empty missions with ids 1000..., 2000..., 3000..."""
    ids = np.zeros((missions, 2), dtype=np.uint64)
    ids[:, 0] = (np.arange(missions, dtype=np.uint64) + 1) << np.uint64(60)
    ids[:, 1] = 7
    return VIMap(
        missions=Missions.filled(missions, id=ids, baseframe=np.arange(missions)),
        baseframes=BaseFrames.filled(missions, id=ids),
    )


def make_registry() -> Registry:
    """Return a registry with the sample plugin and the console's own."""
    from maplab_plugins import console

    registry = Registry()
    for name, module in (("console", console), ("sample", sys.modules[__name__])):
        plugin = Plugin(name, module.__name__, "1.0")
        registry.plugins.append(plugin)
        registry.add_module(module, plugin)
    return registry


def make_session() -> Session:
    """Return a session with the sample plugin."""
    return Session(make_registry())
