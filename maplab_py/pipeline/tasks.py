"""Tasks: map folders and commands that become one folder."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Sequence
from pathlib import Path

from maplab_py.errors import UserError
from maplab_py.pipeline.plan import MAP_TEMPLATE, Stage


@dataclasses.dataclass(frozen=True)
class Task:
    """Commands on map folders.

    Attributes:
        stage: Name of its stage.
        name: Unique in the stage; the result's folder is called so.
        inputs: Map folders that it reads.
        commands: Commands of its stage.
        lines: The same with the inputs put in; `<RESULT_FOLDER>` is not replaced yet.
        result: Folder that it writes.
        edits_input: The result is the map itself, which the commands save.
        memory_gb: Most memory [GB]; 0 = no limit of its own.
    """

    stage: str
    name: str
    inputs: tuple[Path, ...]
    commands: tuple[str, ...]
    lines: tuple[str, ...]
    result: Path
    edits_input: bool
    memory_gb: float

    @property
    def title(self) -> str:
        """Stage and name."""
        return f"{self.stage}/{self.name}"

    @property
    def script(self) -> str:
        """The commands as a script; `<RESULT_FOLDER>` is not replaced yet."""
        return "".join(line + "\n" for line in self.lines)


def task_on(
    stage: Stage, name: str, inputs: Sequence[Path], results: Path, *, edits_input: bool
) -> Task:
    """Return the task of a stage on some maps; see `Stage.commands`.

    Args:
        stage: What to run.
        name: Name of the task.
        inputs: Map folders.
        results: Folder of all results.
        edits_input: The commands save the only map where it is.
    """
    lines: list[str] = []
    for line in stage.commands:
        repeated = inputs if MAP_TEMPLATE in line else inputs[:1]
        lines += [line.replace(MAP_TEMPLATE, _word(folder)) for folder in repeated]
    result = inputs[0] if edits_input else results / stage.name / name
    return Task(
        stage.name,
        name,
        tuple(inputs),
        stage.commands,
        tuple(lines),
        result,
        edits_input,
        stage.memory_gb,
    )


def names_of(folders: Sequence[Path]) -> list[str]:
    """Return a short unique name per folder: its own, with as many parents as it takes.

    Raises:
        UserError: Two folders are the same.
    """
    for parts in range(1, 1 + max((len(folder.parts) for folder in folders), default=1)):
        names = ["-".join(folder.parts[-parts:]).strip("/") or "root" for folder in folders]
        if len(set(names)) == len(names):
            return names
    raise UserError("a map folder is given twice")


def _word(folder: Path) -> str:
    """Return a folder as a word of a line, whatever its name holds."""
    return shlex.quote(str(folder))
