"""Watchers never fail a command, and never fail in silence."""

from __future__ import annotations

import logging
from collections.abc import Callable

import pytest

from maplab_py.console.session.maps import MapManager
from maplab_py.console.session.watchers import Watchers
from maplab_py.vimap import VIMap


class Restless:
    """Fails while it is told to."""

    fails = True

    def after_command(self, maps: MapManager) -> None:
        self._look()

    def during_command(self, make_map: Callable[[], VIMap]) -> None:
        self._look()

    def close(self) -> None:
        self._look()

    def _look(self) -> None:
        if self.fails:
            raise RuntimeError("eyes shut")


def test_the_user_is_told_once_until_it_follows_again(caplog: pytest.LogCaptureFixture) -> None:
    told: list[str] = []
    watchers, watcher, maps = Watchers(told.append), Restless(), MapManager()
    watchers.set("viewer", watcher)
    with caplog.at_level(logging.ERROR):
        for _ in range(3):
            watchers.during_command(lambda: pytest.fail("nobody needs the map"))
            watchers.after_command(maps)
    assert len(told) == 1
    assert told[0].startswith("the viewer could not follow the map (see ")
    assert len(caplog.records) == 6
    assert "eyes shut" in caplog.text
    watcher.fails = False
    watchers.after_command(maps)
    watcher.fails = True
    watchers.after_command(maps)
    assert len(told) == 2
    watchers.close()
    assert watchers.find("viewer", Restless) is None
