"""Commands that optimise the selected map, and the one that compiles kernels ahead of time."""

from __future__ import annotations

import dataclasses

from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.algorithms.vi_optimization.report import VIOptimizationReport
from maplab_py.plugin import CommandContext, command
from maplab_py.report import Report

_OPTIONS = VIOptimizationOptions()


@dataclasses.dataclass(frozen=True)
class WarmupReport(Report):
    """Which kernels are ready, and where."""

    kernels: list[str]
    seconds: float
    folder: str


@command("optimize_visual_inertial", "optvi", example="optvi --ba_num_iterations=20")
def optimize_visual_inertial(
    context: CommandContext,
    *,
    options: VIOptimizationOptions = _OPTIONS,
    map_mission: str = "",
    map_mission_list: str = "",
) -> VIOptimizationReport:
    """Optimise poses, velocities, biases and landmarks over images and inertial measurements.

    Args:
        map_mission: Mission id or unambiguous prefix; empty = all missions.
        map_mission_list: Several missions, separated by commas.
    """
    return _optimize(context, options, map_mission, map_mission_list)


@command("optimize_visual", "optv", example="optv --ba_num_iterations=20")
def optimize_visual(
    context: CommandContext,
    *,
    options: VIOptimizationOptions = _OPTIONS,
    map_mission: str = "",
    map_mission_list: str = "",
) -> VIOptimizationReport:
    """Optimise poses and landmarks over images alone.

    Args:
        map_mission: Mission id or unambiguous prefix; empty = all missions.
        map_mission_list: Several missions, separated by commas.
    """
    visual_only = dataclasses.replace(options, include_inertial=False)
    return _optimize(context, visual_only, map_mission, map_mission_list)


@command("warmup", example="warmup", needs_map=False, acts_outside=True)
def warmup(context: CommandContext) -> WarmupReport:
    """Compile every numeric kernel now, so that no later command waits for it."""
    from maplab_py.algorithms.warmup import compile_kernels

    kernels, seconds, folder = compile_kernels(context.progress)
    return WarmupReport(kernels, seconds, folder)


def _optimize(
    context: CommandContext, options: VIOptimizationOptions, mission: str, mission_list: str
) -> VIOptimizationReport:
    from maplab_py.algorithms.vi_optimization.optimization import optimize

    result, report = optimize(
        context.vi_map,
        options,
        missions=context.mission_rows(mission, mission_list),
        progress=context.progress,
        watch=context.session.watchers.during_command,
    )
    context.commit(result)
    return report
