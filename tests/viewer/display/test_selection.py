"""Selections of several pages, as the pages see them."""

from collections.abc import Callable, Iterator

import msgspec.msgpack
import numpy as np
import pytest
from websockets.sync.client import ClientConnection

from maplab_py.viewer.building import Subject
from maplab_py.viewer.display.viewer import Viewer
from maplab_py.viewer.options import VisualizationOptions
from maplab_py.viewer.picking import Pick
from maplab_py.viewer.scene import Entity
from maplab_py.vimap import to_hex
from tests.support.waiting import wait_until
from tests.viewer.display.page_messages import (
    Message,
    PageState,
    is_replayed,
    open_page,
    read_until,
)
from tests.vimap.builders import walk_map

MAP = walk_map(vertices=14, landmarks=300, seed=3)
CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (0.0, -9.0, 0.0),
    "fov": 0.8, "near": 0.1, "far": 100.0, "image_height": 600, "image_width": 900,
    "look_at": (0.0, 0.0, 0.0), "up_direction": (0.0, 0.0, 1.0),
}  # fmt: skip


@pytest.fixture
def viewer() -> Iterator[Viewer]:
    viewer = Viewer(0)
    viewer.show(Subject(MAP, "walk", VisualizationOptions(scale=2.0)))
    viewer.set_layers({"vertices"})
    yield viewer
    viewer.stop()


class OpenPage:
    """An open page, its state as far as it has read."""

    def __init__(
        self, viewer: Viewer, connection: ClientConnection, text: str = "Click a vertex"
    ) -> None:
        self._connection = connection
        self.state = PageState()
        self._read(lambda messages: any(map(is_replayed, messages)))
        before = set(viewer.selections.pages)  # pages that have been closed may still leave
        connection.send(msgspec.msgpack.encode(CAMERA))
        assert wait_until(lambda: bool(set(viewer.selections.pages) - before), 20.0)
        self.wait_for_text(text)

    def _read(self, is_enough: Callable[[list[Message]], bool]) -> None:
        messages: list[Message] = []
        while not is_enough(messages):
            for message in read_until(self._connection, lambda _: True):
                messages.append(message)
                self.state.apply(message)

    def wait_for_text(self, text: str) -> None:
        self._read(lambda _: text in self.state.html)

    def wait_for_marks(self) -> None:
        self._read(lambda _: any(path.startswith("/pick/") for path in self.state.nodes))

    def click(self, viewer: Viewer, row: int) -> None:
        """Click a vertex."""
        p = viewer.drawing.p_vertices[row]
        eye = np.add(p, [0.0, -5.0, 5.0])
        message = {
            "type": "ScenePointerMessage", "event_type": "click", "ray_origin": eye.tolist(),
            "ray_direction": (p - eye).tolist(), "screen_pos": ((0.5, 0.5),), "modifier": None,
        }  # fmt: skip
        self._connection.send(msgspec.msgpack.encode(message))


def test_each_page_has_its_selection_and_the_console_selects_in_all(viewer: Viewer) -> None:
    with open_page(viewer) as first_connection, open_page(viewer) as second_connection:
        first, second = (OpenPage(viewer, c) for c in (first_connection, second_connection))
        told: list[str] = []
        viewer.selections.on_pick = told.append
        first.click(viewer, 7)
        first.wait_for_text("8 of 14")
        first.wait_for_marks()
        second.click(viewer, 3)
        second.wait_for_text("4 of 14")
        assert "8 of 14" not in second.state.html
        ids = [to_hex(MAP.vertices.id[row]) for row in (7, 3)]
        assert wait_until(lambda: told == ids, 20.0)  # after the marks have been sent
        assert viewer.selection.picked is not None
        assert viewer.selection.picked.row == 3
        viewer.select(Pick(Entity.VERTEX, 11, viewer.drawing.p_vertices[11], 0.0))
        for page in (first, second):
            page.wait_for_text("12 of 14")
    assert wait_until(lambda: viewer.pages == 0, 20.0)
    with open_page(viewer) as connection:  # it begins with what the console has selected
        OpenPage(viewer, connection, "12 of 14").wait_for_marks()
    viewer.show(Subject(MAP.replace(), "walk"))
    assert viewer.selection.picked is None


@pytest.mark.filterwarnings("ignore:Queued a FrameMessage on a closed connection")
def test_a_page_that_closes_while_the_map_is_replaced_is_left_out(viewer: Viewer) -> None:
    with open_page(viewer) as connection:
        OpenPage(viewer, connection)
        leaving = dict(viewer.selections.pages)
    assert wait_until(lambda: not viewer.selections.pages, 20.0)
    viewer.selections.pages.update(leaving)  # as before its end has been told
    viewer.select(Pick(Entity.VERTEX, 11, viewer.drawing.p_vertices[11], 0.0))
    viewer.selections.show_image(np.zeros((8, 8, 3), dtype=np.uint8))
    viewer.show(Subject(MAP.replace(), "walk"))
    assert viewer.selection.picked is None
