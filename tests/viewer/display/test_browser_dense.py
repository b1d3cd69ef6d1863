"""Meshes by every rule, a slice of distances, and the depth of a picked vertex in a real browser."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maplab_py.storage.resources.new import NewResources
from maplab_py.viewer.building import Subject
from maplab_py.viewer.display.viewer import Viewer
from maplab_py.viewer.layers.clouds import Cloud
from maplab_py.viewer.mesh_sources import coloured_mesh
from maplab_py.viewer.options import MeshColouring, VisualizationOptions
from maplab_py.viewer.resource_clouds import VertexImages
from tests.viewer.display.browsing import IN_BROWSER, Page, chromium, place_on_page
from tests.vimap.builders import walk_map

pytestmark = IN_BROWSER

MAP = walk_map(vertices=14, landmarks=40, seed=3)
SUBJECT = Subject(MAP, "walk", VisualizationOptions(scale=2.0))
MIDDLE = MAP.T_G_I[:, 4:].mean(axis=0)
CORNERS = MIDDLE + 3.0 * np.array([[-1, -1, -1], [1, -1, -0.5], [1, 1, 1], [-1, 1, 0.5]])
FACES = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
OWN = np.tile(np.array([200, 30, 200], dtype=np.uint8), (4, 1))
GROUND = Cloud("ground", CORNERS - [0.0, 0.0, 1.0], faces=FACES[:1])


@pytest.fixture(scope="module")
def viewer() -> Iterator[Viewer]:
    viewer = Viewer(0)
    viewer.show(SUBJECT)
    yield viewer
    viewer.stop()


@pytest.fixture(scope="module")
def page(viewer: Viewer) -> Iterator[Page]:
    with chromium() as browser:
        opened = Page(browser, viewer.url)
        assert opened.wait_until(lambda: viewer.pages == 1)
        yield opened


def of_one_colour(picture: Any) -> int:
    """Return how many pixels are clearly coloured: neither grey nor the background."""
    channels = picture.astype(int)
    return int(np.count_nonzero(channels.max(axis=2) - channels.min(axis=2) > 40))


@pytest.mark.parametrize(("rule", "legend"), [("shaded", ""), ("distance", "distance")])
def test_a_mesh_by_every_rule(page: Page, viewer: Viewer, rule: MeshColouring, legend: str) -> None:
    viewer.show(SUBJECT)
    viewer.look_at_everything()
    assert page.wait_until(lambda: page.page.get_by_text("Surface 2").count() == 0)
    before = page.still_picture()
    mesh = coloured_mesh(Cloud("Surface", CORNERS, OWN, faces=FACES), rule, GROUND)
    viewer.show(dataclasses.replace(SUBJECT, clouds=(mesh,)))
    assert page.wait_until(lambda: page.page.get_by_text("Surface 2").count() == 1)

    def changed() -> int:
        difference = np.abs(page.picture().astype(int) - before.astype(int)).max(axis=2)
        return int(np.count_nonzero(difference > 30))

    assert page.wait_until(lambda: changed() > 5000)
    assert page.wait_until(lambda: of_one_colour(page.picture()) > of_one_colour(before) + 2000)
    if legend:
        assert page.wait_until(lambda: page.page.get_by_text(legend, exact=True).count() >= 1)
    assert page.errors == []


def test_a_picked_vertex_shows_its_image_and_its_depth(
    page: Page, viewer: Viewer, tmp_path: Path
) -> None:
    new = NewResources(tmp_path)
    depth = np.tile(np.linspace(500, 4000, 80).astype(np.uint16), (60, 1))
    rows = [new.add_image(np.full((60, 80), 90, dtype=np.uint8)), new.add_image(depth, 8)]
    frame = int(MAP.frame_start[7])
    vi_map = new.attached(MAP, rows, [frame, frame])
    images = VertexImages(vi_map, Path(), with_depth=True)
    viewer.show(dataclasses.replace(SUBJECT, vi_map=vi_map, images=images))
    viewer.set_layer("loop_closures", False)
    viewer.look_at_everything()
    page.settle(1200)
    page.still_picture()
    page.page.mouse.click(*place_on_page(viewer, MAP.T_G_I[7, 4:]))
    assert page.wait_until(lambda: viewer.selection.picked is not None)
    picked = viewer.selection.picked
    assert picked is not None
    assert picked.row == 7
    sizes = "() => [...document.images].map(i => [i.naturalWidth, i.naturalHeight])"
    assert page.wait_until(lambda: [80, 120] in page.page.evaluate(sizes))
    assert page.errors == []
