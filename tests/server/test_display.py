"""The published map is shown now and then."""

from __future__ import annotations

import pytest

from maplab_py.errors import FlagError
from maplab_py.server.options import ServiceOptions
from maplab_py.server.publishing import Display
from maplab_py.vimap import VIMap

MAPS = [VIMap() for _ in range(4)]


def test_every_map_is_shown_without_an_interval() -> None:
    seen: list[VIMap] = []
    display = Display(seen.append, 0.0)
    for vi_map in MAPS:
        display.offer(vi_map)
    assert all(a is b for a, b in zip(seen, MAPS, strict=True))
    display.show(at_once=True)
    assert len(seen) == len(MAPS)


def test_the_latest_map_is_shown_when_its_time_has_come(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr("maplab_py.server.publishing.time.monotonic", lambda: now[0])
    seen: list[VIMap] = []
    display = Display(seen.append, 10.0)
    display.offer(MAPS[0])
    display.offer(MAPS[1])
    display.offer(MAPS[2])
    now[0] += 9.9
    display.show()
    assert seen == [MAPS[0]]
    now[0] += 0.2
    display.show()
    display.show()
    assert [MAPS.index(vi_map) for vi_map in seen] == [0, 2]
    display.offer(MAPS[3])
    display.show(at_once=True)
    assert MAPS.index(seen[-1]) == 3


def test_a_deleted_map_is_not_shown() -> None:
    seen: list[VIMap] = []
    display = Display(seen.append, 0.0)
    display.offer(None)
    Display(None, 0.0).offer(MAPS[0])
    assert seen == []


@pytest.mark.parametrize("name", ["stop_when_idle_s", "visualization_interval_s"])
def test_negative_times_are_refused(name: str) -> None:
    with pytest.raises(FlagError, match=f"--serve_{name}=.*: must be at least 0"):
        ServiceOptions(**{name: -1.0})
