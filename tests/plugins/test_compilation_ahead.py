"""At the prompt the kernels of the selected map's cameras are compiled once, if the user wants it."""

from __future__ import annotations

from typing import ClassVar

import pytest
from maplab_plugins.map_optimization.compilation import CompilationAhead, compile_ahead

import maplab_py
from maplab_py.algorithms import background_compilation
from maplab_py.algorithms.rig_warmup import RigKernels
from maplab_py.console.session.maps import MapManager
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import VIMap
from tests.support.waiting import wait_until
from tests.vimap.builders import sensors, walk_map


class Started:
    """Stands in for processes."""

    rigs: ClassVar[list[RigKernels]] = []
    waits = closes = 0

    def __init__(self, rig: RigKernels, jobs: tuple[str, ...]) -> None:
        assert jobs == ("reprojection",)
        self.rigs.append(rig)

    def wait(self, progress: Progress) -> None:
        assert progress is SILENT
        type(self).waits += 1

    def close(self) -> None:
        type(self).closes += 1


@pytest.fixture(autouse=True)
def started(monkeypatch: pytest.MonkeyPatch) -> type[Started]:
    Started.rigs.clear()
    Started.waits = Started.closes = 0
    monkeypatch.setattr(background_compilation, "BackgroundCompilation", Started)
    monkeypatch.setattr(RigKernels, "missing", lambda _: ("reprojection",))
    return Started


def maps_with(vi_map: VIMap) -> MapManager:
    maps = MapManager()
    maps.add("walk", vi_map)
    return maps


def test_a_rig_is_compiled_once_and_waited_for(started: type[Started]) -> None:
    ahead = CompilationAhead(lambda: True)
    ahead.after_command(MapManager())
    assert not started.rigs
    ahead.after_command(maps_with(walk_map()))
    ahead.wait(SILENT)
    assert started.waits == 1
    other = walk_map().replace(sensors=sensors(310.0))  # another calibration, the same models
    ahead.after_command(maps_with(other))
    ahead.wait(SILENT)
    assert len(started.rigs) == 1
    ahead.close()
    assert started.closes == 1


def test_it_can_be_switched_off(started: type[Started]) -> None:
    session = maplab_py.Session()
    session.set_flags(["compile_ahead=false"])
    ahead = compile_ahead(session)
    ahead.after_command(maps_with(walk_map()))
    ahead.wait(SILENT)
    assert not started.rigs
    session.set_flags(["compile_ahead=true"])
    ahead.after_command(maps_with(walk_map()))
    assert wait_until(lambda: started.rigs)


def test_only_the_prompt_has_it(started: type[Started]) -> None:
    session = maplab_py.Session()
    (make,) = session.registry.prompt_watchers.values()
    assert isinstance(make(session), CompilationAhead)
    session.maps.add("walk", walk_map())
    session.run("map_stats")
    assert not started.rigs


def test_a_map_whose_cameras_are_unknown_is_left_alone(started: type[Started]) -> None:
    vi_map = walk_map()
    broken = vi_map.replace(sensors=type(vi_map.sensors)())
    ahead = CompilationAhead(lambda: True)
    ahead.after_command(maps_with(broken))
    ahead.wait(SILENT)
    assert not started.rigs
