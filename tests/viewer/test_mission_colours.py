"""Colours of missions, each its own or one a name."""

from __future__ import annotations

import numpy as np

from maplab_py.storage.mission_names import named
from maplab_py.viewer.drawing import make_drawing
from maplab_py.viewer.options import VisualizationOptions
from maplab_py.vimap.merge import merge_maps
from tests.simulation.small import simulated


def test_missions_of_one_robot_have_one_colour_if_that_is_wanted() -> None:
    first, second = simulated().maps
    three, _ = merge_maps(merge_maps(first, second)[0], first, assign_new_ids=True)
    three = named(three, ["ant", "bee", "ant"])
    colours = make_drawing(three, VisualizationOptions()).mission_colours
    assert len(np.unique(colours, axis=0)) == 3
    by_name = make_drawing(three, VisualizationOptions(color_missions_by_name=True))
    assert np.array_equal(by_name.mission_colours, colours[[0, 1, 0]])
    unnamed = make_drawing(named(three, ["", "", ""]), by_name.options)
    assert np.array_equal(unnamed.mission_colours, colours)
