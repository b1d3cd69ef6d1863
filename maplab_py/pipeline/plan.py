"""Plan of a pipeline: stages of commands over maps, and their dependencies."""

import dataclasses
import graphlib
import re
from pathlib import Path

from maplab_py.errors import UserError

MAPS = "maps"
"""Name by which a stage refers to the map folders that the pipeline starts from."""
MAP_TEMPLATE = "<CURRENT_VIMAP_FOLDER>"
RESULT_TEMPLATE = "<RESULT_FOLDER>"
IN_PLACE = "batch"
"""Name of the only stage of a batch file without stages: its commands edit the maps where they are."""
_NAME = re.compile(r"[a-z0-9][a-z0-9_]*")


@dataclasses.dataclass(frozen=True)
class Stage:
    """Commands that are run once per map (`each`), or once on several maps together (`all`)."""

    name: str  # letters, digits and underscores; the results lie in a folder of this name
    # lines of the console. `<CURRENT_VIMAP_FOLDER>` is the map's folder; with `all`, a line that names it is
    # repeated for every map. `<RESULT_FOLDER>` is the folder of the result
    commands: tuple[str, ...]
    # a task per map of this stage; `maps` for the maps that the pipeline starts from
    each: str = ""
    all: tuple[str, ...] = ()  # one task with all maps of these stages, in their order
    memory_gb: float = 0.0  # most memory of a task [GB]; 0 = what the scheduler allows

    @property
    def sources(self) -> tuple[str, ...]:
        """Names of the stages whose maps it takes."""
        return (self.each,) if self.each else self.all


@dataclasses.dataclass(frozen=True)
class Pipeline:
    """Stages over map folders."""

    origin: str  # file that described it, for messages
    maps: tuple[Path, ...]  # map folders to start from
    stages: tuple[Stage, ...]  # in any order

    @property
    def is_in_place(self) -> bool:
        """Tell whether the commands edit the maps where they are: a batch file without stages."""
        return [stage.name for stage in self.stages] == [IN_PLACE]


def in_place(origin: str, maps: tuple[Path, ...], commands: tuple[str, ...]) -> Pipeline:
    """Return the pipeline of a batch file without stages: one task per map, which edits the map."""
    return Pipeline(origin, maps, (Stage(IN_PLACE, commands, each=MAPS),))


def ordered(pipeline: Pipeline) -> tuple[Stage, ...]:
    """Check a pipeline and return its stages so that each follows those that it needs.

    Raises:
        UserError: There are no stages, a name is wrong or used twice, a stage needs one that does not
            exist, stages need each other in a circle, or a stage writes no result.
    """
    origin = pipeline.origin
    by_name: dict[str, Stage] = {}
    if not pipeline.stages:
        raise UserError(f"{origin}: has no stages")
    for stage in pipeline.stages:
        _check_stage(stage, pipeline)
        if stage.name in by_name:
            raise UserError(f"{origin}: two stages have the name {stage.name}")
        by_name[stage.name] = stage
    for stage in pipeline.stages:
        for source in stage.sources:
            if source != MAPS and source not in by_name:
                raise UserError(
                    f"{origin}: stage {stage.name} needs a stage {source}, which does not exist"
                )
    place = {stage.name: number for number, stage in enumerate(pipeline.stages)}
    sorter = graphlib.TopologicalSorter(
        {stage.name: [s for s in stage.sources if s != MAPS] for stage in pipeline.stages}
    )
    try:
        sorter.prepare()
    except graphlib.CycleError as error:
        circle = " needs ".join(reversed(error.args[1]))
        raise UserError(f"{origin}: the stages run in a circle: {circle}") from None
    names: list[str] = []
    while sorter.is_active():
        ready = sorted(sorter.get_ready(), key=place.__getitem__)
        names += ready
        sorter.done(*ready)
    return tuple(by_name[name] for name in names)


def _check_stage(stage: Stage, pipeline: Pipeline) -> None:
    name, origin = stage.name, pipeline.origin
    if not _NAME.fullmatch(name) or name == MAPS:
        raise UserError(
            f"{origin}: '{name}' cannot be the name of a stage (small letters, digits and "
            f"underscores; not '{MAPS}')"
        )
    if bool(stage.each) == bool(stage.all):
        raise UserError(f"{origin}: stage {name} needs one of 'each' and 'all'")
    if not stage.commands:
        raise UserError(f"{origin}: stage {name} has no commands")
    if stage.memory_gb < 0.0:
        raise UserError(f"{origin}: stage {name}: memory_gb={stage.memory_gb:g} is negative")
    if not pipeline.is_in_place and not any(RESULT_TEMPLATE in line for line in stage.commands):
        raise UserError(
            f"{origin}: stage {name}: no command writes to {RESULT_TEMPLATE} (end with: "
            f"save --map_folder={RESULT_TEMPLATE})"
        )
