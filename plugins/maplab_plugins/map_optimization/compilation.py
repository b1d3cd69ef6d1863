"""Kernels compiled before they are needed: all by `warmup`, those of a map's cameras at the prompt."""

from __future__ import annotations

import dataclasses
import logging
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING

from maplab_py.console.session.watchers import prompt_watcher
from maplab_py.errors import MaplabError
from maplab_py.plugin import CommandContext, Progress, Report, command

if TYPE_CHECKING:
    from maplab_py.algorithms.background_compilation import BackgroundCompilation
    from maplab_py.algorithms.rig_warmup import RigKernels
    from maplab_py.console.session.maps import MapManager
    from maplab_py.console.session.session import Session
    from maplab_py.vimap import VIMap

_NAME = "compilation of kernels"
_logger = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class WarmupReport(Report):
    """Compiled kernels and their cache."""

    kernels: list[str]
    seconds: float
    folder: str


@command("warmup", example="warmup", needs_map=False, acts_outside=True, guards_effects=True)
def warmup(context: CommandContext) -> WarmupReport:
    """Compile every numeric kernel now, so that no later command waits for it."""
    from maplab_py.algorithms.warmup import compile_kernels
    from maplab_py.frontend.initialization import gyro_bias
    from maplab_py.simulation.warmup import RENDERING, compile_rendering

    others = {
        RENDERING: compile_rendering,
        "start of the odometry": gyro_bias.compile_kernels,
    }
    kernels, seconds, folder = compile_kernels(context.progress, others)
    return WarmupReport(kernels, seconds, folder)


class CompilationAhead:
    """Watches which map is selected and compiles the kernels of its cameras.

    Looking for what the disk has takes about a second on the first map, because it imports the
    optimiser, and is done in a thread.
    """

    def __init__(self, is_wanted: Callable[[], bool]) -> None:
        """Wait for a map.

        Args:
            is_wanted: Asked after every command; False = start nothing.
        """
        self._is_wanted = is_wanted
        self._sensors: object = None  # of the map that was looked at last
        self._rigs: set[RigKernels] = set()
        self._compilations: list[BackgroundCompilation] = []
        self._look: threading.Thread | None = None
        self._is_closed = threading.Event()

    def after_command(self, maps: MapManager) -> None:
        """Look at the selected map if its sensors are others than before."""
        if not maps.selected_key or not self._is_wanted():
            return
        vi_map = maps.selected.vi_map
        if vi_map.sensors is self._sensors or (self._look and self._look.is_alive()):
            return
        self._sensors = vi_map.sensors
        self._look = threading.Thread(target=self._look_at, args=(vi_map,), daemon=True)
        self._look.start()

    def during_command(self, make_map: Callable[[], VIMap]) -> None:
        """Do nothing: cameras do not change during a command."""

    def wait(self, progress: Progress) -> None:
        """Wait until everything that was started is compiled; raises Cancelled as `progress` does."""
        while self._look is not None and self._look.is_alive():
            progress.check()
            self._look.join(0.1)
        for compilation in self._compilations:
            compilation.wait(progress)

    def close(self) -> None:
        """End the processes."""
        self._is_closed.set()
        for compilation in self._compilations:
            compilation.close()

    def _look_at(self, vi_map: VIMap) -> None:
        from maplab_py.algorithms.background_compilation import BackgroundCompilation
        from maplab_py.algorithms.rig_warmup import RigKernels

        try:
            rig = RigKernels.of_map(vi_map)
            missing = () if rig in self._rigs else rig.missing()
            self._rigs.add(rig)
        except (MaplabError, OSError):  # the command that needs the kernels will say so
            _logger.exception("the kernels of the map's cameras are not compiled ahead")
            return
        if missing and not self._is_closed.is_set():
            _logger.info("compiling kernels ahead: %s", ", ".join(missing))
            self._compilations.append(BackgroundCompilation(rig, missing))
        if self._is_closed.is_set():
            self.close()


@prompt_watcher(_NAME)
def compile_ahead(session: Session) -> CompilationAhead:
    """Compile the kernels of the selected map's cameras while the user reads."""
    return CompilationAhead(lambda: session.settings.is_on("compile_ahead"))


def wait_for_kernels(context: CommandContext) -> None:
    """Wait until the kernels of the map's cameras are compiled, if something compiles them."""
    ahead = context.session.watchers.find(_NAME, CompilationAhead)
    if ahead is not None:
        ahead.wait(context.progress)
