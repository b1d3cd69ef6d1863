"""All kernels compiled before they are needed."""

from __future__ import annotations

import dataclasses

from maplab_py.plugin import CommandContext, Report, command


@dataclasses.dataclass(frozen=True)
class WarmupReport(Report):
    """Number of kernels that are ready, and their folder."""

    kernels: list[str]
    seconds: float
    folder: str


@command("warmup", example="warmup", needs_map=False, acts_outside=True, guards_effects=True)
def warmup(context: CommandContext) -> WarmupReport:
    """Compile every numeric kernel that the installation does not bring, so that nothing waits later."""
    from maplab_py.warmup import compile_kernels

    return WarmupReport(*compile_kernels(context.progress))
