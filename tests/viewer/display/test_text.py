"""The panel's texts: what comes from outside is shown as it is and never becomes markup."""

from __future__ import annotations

import dataclasses

import pytest

from maplab_py.viewer.building import Subject, build_scene
from maplab_py.viewer.display import panel
from maplab_py.viewer.options import VisualizationOptions
from maplab_py.viewer.scene import LegendEntry, Scene
from tests.vimap.builders import walk_map

HOSTILE = "<img src=x onerror=alert(1)> & co"
SHOWN = "&lt;img src=x onerror=alert(1)&gt; &amp; co"


def scene(title: str) -> Scene:
    return build_scene(Subject(walk_map(), title, VisualizationOptions()))


@pytest.mark.parametrize(
    "markup",
    [
        lambda: panel.header(scene(HOSTILE)),
        lambda: panel.header(dataclasses.replace(scene("map"), notes=(HOSTILE,))),
        lambda: panel.legend([LegendEntry(HOSTILE, ("#000000",))]),
        lambda: panel.legend([LegendEntry(HOSTILE, ("#000000", "#ffffff"), "0", "1")]),
        lambda: panel.legend([LegendEntry("seen", ("#000000", "#ffffff"), HOSTILE, "1")]),
        lambda: panel.legend([LegendEntry("seen", ("#000000", "#ffffff"), "0", HOSTILE)]),
        lambda: panel.fact_table([(HOSTILE, "value")]),
        lambda: panel.fact_table([("name", HOSTILE)]),
        lambda: panel.hint(HOSTILE),
    ],
)
def test_texts_are_escaped(markup) -> None:
    html = markup()
    assert SHOWN in html
    assert "<img" not in html
