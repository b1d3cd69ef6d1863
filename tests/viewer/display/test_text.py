"""The panel's texts: what comes from outside is shown as it is and never becomes markup."""

from __future__ import annotations

import dataclasses

import pytest

from maplab_py.viewer.building import Subject, build_scene
from maplab_py.viewer.display import text
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
        lambda: text.header(scene(HOSTILE)),
        lambda: text.header(dataclasses.replace(scene("map"), notes=(HOSTILE,))),
        lambda: text.legend([LegendEntry(HOSTILE, ("#000000",))]),
        lambda: text.legend([LegendEntry(HOSTILE, ("#000000", "#ffffff"), "0", "1")]),
        lambda: text.legend([LegendEntry("seen", ("#000000", "#ffffff"), HOSTILE, "1")]),
        lambda: text.legend([LegendEntry("seen", ("#000000", "#ffffff"), "0", HOSTILE)]),
        lambda: text.fact_table([(HOSTILE, "value")]),
        lambda: text.fact_table([("name", HOSTILE)]),
        lambda: text.hint(HOSTILE),
    ],
)
def test_texts_are_escaped(markup) -> None:
    html = markup()
    assert SHOWN in html
    assert "<img" not in html
