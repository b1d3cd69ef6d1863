"""What the viewer sends to an open page, read from a connection as a browser reads it."""

import dataclasses
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import msgspec.msgpack
import viser
import zstandard
from websockets.sync.client import ClientConnection, connect

from maplab_py.viewer.display.viewer import Viewer

_HEADER = 16
"""Bytes of two lengths, the second that of the compressed messages."""

Message = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class PageState:
    """The scene and the panel of a page.

    Attributes:
        nodes: Whether each node of the scene is visible, by path.
        controls: Type, value and properties of each control of the panel, by id.
    """

    nodes: dict[str, bool] = dataclasses.field(default_factory=dict)
    controls: dict[str, Message] = dataclasses.field(default_factory=dict)

    @property
    def drawn(self) -> set[tuple[str, str]]:
        """Layer and mission of each drawn part of the map."""
        parts = [path.split("/")[2:] for path in self.nodes if path.startswith("/map/")]
        return {(part[0], part[1]) for part in parts}

    @property
    def layers(self) -> set[str]:
        """Names of the layers that are drawn."""
        return {layer for layer, _ in self.drawn}

    def steps(self, *, visible_only: bool = False) -> set[int]:
        """Return the steps of playback that have nodes.

        Args:
            visible_only: Leave out steps without a visible node.
        """
        steps = {path: path.split("/")[2] for path in self.nodes if path.startswith("/play/")}
        return {
            int(step)
            for path, step in steps.items()
            if step.isdecimal() and (self.nodes[path] or not visible_only)
        }

    def control(self, **wanted: str) -> Message:
        """Return the only control with these properties."""
        (control,) = (c for c in self.controls.values() if wanted.items() <= c.items())
        return control

    @property
    def html(self) -> str:
        """All text of the panel, among it the legend."""
        return "".join(str(c.get("content", "")) for c in self.controls.values())

    def apply(self, message: Message) -> None:
        """Change the page as a message asks."""
        kind = message["type"]
        if kind == "RemoveSceneNodeMessage":
            self.nodes.pop(message["name"], None)
        elif kind == "GuiRemoveMessage":
            self.controls.pop(message["uuid"], None)
        elif kind == "SetSceneNodeVisibilityMessage":
            if message["name"] in self.nodes:
                self.nodes[message["name"]] = message["visible"]
        elif kind == "GuiUpdateMessage":
            self.controls.get(message["uuid"], {}).update(message["updates"])
        elif "props" in message and "uuid" in message:
            props = message["props"]
            self.controls[message["uuid"]] = {"type": kind, **message, **props}
        elif "props" in message and not message.get("virtual", False):
            self.nodes[message["name"]] = True


@contextmanager
def open_page(viewer: Viewer) -> Iterator[ClientConnection]:
    """Connect to a viewer as a page does."""
    url = viewer.url.replace("http", "ws", 1)
    protocol = f"viser-v{viser.__version__}"
    with connect(url, subprotocols=[protocol], max_size=None) as connection:
        yield connection


def read_until(connection: ClientConnection, is_last: Callable[[Message], bool]) -> list[Message]:
    """Return the messages up to the first that is the last."""
    messages: list[Message] = []
    while not any(is_last(message) for message in messages):
        data = connection.recv(timeout=20.0)
        assert isinstance(data, bytes)
        messages += decoded(data)
    return messages


def decoded(data: bytes) -> list[Message]:
    """Return the messages of one frame of the connection."""
    end = _HEADER + int.from_bytes(data[8:_HEADER], "little")
    content = zstandard.ZstdDecompressor().decompress(data[_HEADER:end])
    messages: list[Message] = msgspec.msgpack.decode(content)["messages"]
    return messages


def is_replayed(message: Message) -> bool:
    """Tell whether the page has heard all that was sent before it was opened."""
    return bool(message["type"] == "ReplayDoneMessage")


def page_state(viewer: Viewer) -> PageState:
    """Return what a page that is opened now shows."""
    state = PageState()
    with open_page(viewer) as connection:
        for message in read_until(connection, is_replayed):
            state.apply(message)
    return state
