"""Commands that optimise the selected map, and `warmup`."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.plugin import ALL_MISSIONS, CommandContext, MissionChoice, Report, command

if TYPE_CHECKING:
    from maplab_py.algorithms.vi_optimization.reports import VIOptimizationReport


@command("optimize_visual_inertial", "optvi", example="optvi --ba_num_iterations=20")
def optimize_visual_inertial(
    context: CommandContext,
    *,
    options: VIOptimizationOptions = VIOptimizationOptions(calibration="auto"),
    chosen: MissionChoice = ALL_MISSIONS,
) -> VIOptimizationReport:
    """Optimise poses, velocities, biases and landmarks from images and inertial measurements."""
    return _optimize(context, options, chosen)


@command("optimize_visual", "optv", example="optv --ba_num_iterations=20")
def optimize_visual(
    context: CommandContext,
    *,
    options: VIOptimizationOptions = VIOptimizationOptions(),
    chosen: MissionChoice = ALL_MISSIONS,
) -> VIOptimizationReport:
    """Optimise poses and landmarks from images alone."""
    visual_only = dataclasses.replace(options, include_inertial=False)
    return _optimize(context, visual_only, chosen)


def _optimize(
    context: CommandContext, options: VIOptimizationOptions, chosen: MissionChoice
) -> VIOptimizationReport:
    from maplab_py.algorithms.vi_optimization.optimization import optimize

    return context.apply(
        optimize,
        options,
        missions=chosen.rows(context.vi_map),
        progress=context.progress,
        watch=context.session.watchers.during_command,
    )


class WarmupReport(Report):
    """Number of kernels that are ready, and their folder."""

    kernels: list[str]
    seconds: float
    folder: str


@command("warmup", needs_map=False, guards_effects=True)
def warmup(context: CommandContext) -> WarmupReport:
    """Compile every numeric kernel that the installation does not bring, so that nothing waits later."""
    from maplab_py.warmup import compile_kernels

    return WarmupReport(*compile_kernels(context.progress))
