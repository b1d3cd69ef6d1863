"""Parts of a scene as nodes of viser; only what has changed is sent."""

import dataclasses
import functools
import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import viser

from maplab_py.array_types import F32, F64, I64, U8
from maplab_py.interop.mesh_files import shown_glb
from maplab_py.viewer.colours import linear_light
from maplab_py.viewer.drawing import axis_lines, with_end_labels
from maplab_py.viewer.ground import Ground
from maplab_py.viewer.scene import (
    WHOLE_MAP,
    Axes,
    Mesh,
    Part,
    Points,
    Scene,
    Segments,
    is_same_part,
)

_NodeKey = tuple[str, str]  # layer name, mission id

LIGHT_GROUND = (255, 255, 255)
DARK_GROUND = (20, 20, 20)


@dataclasses.dataclass
class _Node:
    part: Part
    handles: list[Any]


class Nodes:
    """The nodes of one scene on a server."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._nodes: dict[_NodeKey, _Node] = {}
        self._ground: list[Any] = []
        self._is_ground_visible = True
        self.point_scale = 1.0  # factor on the size of all points

    def show(self, scene: Scene, layers: set[str], missions: set[str]) -> int:
        """Send what differs from what is drawn; return the number of nodes that were sent.

        Only visible layers are sent; those that are hidden follow when they are shown.
        """
        scene = with_end_labels(scene, missions)
        wanted = {
            (layer.name, mission_id): part
            for layer in scene.layers
            if layer.name in layers
            for mission_id, part in layer.parts.items()
            if mission_id == WHOLE_MAP or mission_id in missions
        }
        sent = 0
        with self._server.atomic():
            for key in set(self._nodes) - set(wanted):
                self._remove(key)
            for key, part in wanted.items():
                before = self._nodes.get(key)
                if before is not None and is_same_part(before.part, part):
                    continue
                sent += 1
                if before is None or not _moved_in_place(self._server, key, before, part):
                    if before is not None:
                        self._remove(key)
                    handles = add_part(self._server, _node_name(*key), part, self.point_scale)
                    self._nodes[key] = _Node(part, handles)
        return sent

    @contextmanager
    def with_hidden(self, scene: Scene, layers: set[str], missions: set[str]) -> Iterator[None]:
        """Send hidden layers too, as nodes that are not visible, for as long as this lasts."""
        with self._server.atomic():
            self.show(scene, set(scene.names), missions)
            for (layer, *_), node in self._nodes.items():
                for handle in node.handles if layer not in layers else ():
                    handle.visible = False
        try:
            yield
        finally:
            self.show(scene, layers, missions)

    def scale_points(self, factor: float) -> None:
        """Draw all points larger or smaller."""
        self.point_scale = factor
        for node in self._nodes.values():
            if isinstance(node.part, Points):
                node.handles[0].point_size = node.part.size_m * factor

    def clear(self) -> None:
        """Remove all nodes."""
        for key in list(self._nodes):
            self._remove(key)

    def show_ground(self, ground: Ground) -> None:
        """Draw a grid at the floor of the map, its axes with coordinates, and the scale bar."""
        for handle in self._ground:
            handle.remove()
        grey, strong = (236, 238, 241), (218, 221, 226)  # page.js has those of dark pages
        scene = self._server.scene
        grid = scene.add_grid(
            "/ground",
            infinite_grid=True,
            plane="xy",
            cell_size=ground.cell_m,
            section_size=ground.section_m,
            cell_color=grey,
            section_color=strong,
            cell_thickness=0.6,
            section_thickness=0.9,
            fade_distance=ground.reach_m,
            fade_strength=1.5,
            fade_from="origin",
            shadow_opacity=0.0,
            position=ground.position,
        )
        self._ground = [
            grid,
            *add_part(self._server, "/scale/axes", ground.axes),
            *add_part(self._server, "/scale/bar", ground.bar),
            *_add_labels(self._server, "/scale", ground.labels, ground.p_labels),
        ]
        if not self._is_ground_visible:
            self.set_ground_visible(False)

    def set_ground_visible(self, is_visible: bool) -> None:
        """Show or hide the grid and what is written on it."""
        self._is_ground_visible = is_visible
        for handle in self._ground:
            handle.visible = is_visible

    def _remove(self, key: _NodeKey) -> None:
        for handle in self._nodes.pop(key).handles:
            handle.remove()


def add_part(
    server: viser.ViserServer, name: str, part: Part, point_scale: float = 1.0
) -> list[Any]:
    """Add one part and return its handles; an empty part has none."""
    scene = server.scene
    if isinstance(part, Axes):
        return _add_axes(server, name, part)
    if not len(part):
        return []
    if isinstance(part, Points):
        order = _shuffle(len(part))
        return [
            scene.add_point_cloud(
                name, part.p[order], part.colours[order], point_size=part.size_m * point_scale,
                point_shape="circle", point_shading="flat", precision="float32",
            ),
            *_add_labels(server, name, part.labels, part.p),
        ]  # fmt: skip
    if isinstance(part, Segments):
        return [
            scene.add_line_segments(
                name,
                part.ends,
                _line_colours(part.colours),
                thickness=part.width_px,
                thickness_units="screen",
            )
        ]
    if is_coloured(part):
        linear = linear_light(np.broadcast_to(part.colours, part.p.shape))
        return [scene.add_glb(name, shown_glb(part.p, part.faces, linear, part.opacity))]
    colour = (int(part.colours[0]), int(part.colours[1]), int(part.colours[2]))
    return [scene.add_mesh_simple(name, part.p, part.faces, color=colour, side="double")]


def _add_axes(server: viser.ViserServer, name: str, part: Axes) -> list[Any]:
    lines = axis_lines(part.T, np.arange(len(part)), part.length_m, 3.0)
    handles = add_part(server, f"{name}/axes", lines)
    return handles + _add_labels(server, name, part.labels, part.T[:, 4:])


def _add_labels(
    server: viser.ViserServer, name: str, labels: tuple[str, ...], p: F64 | F32
) -> list[Any]:
    """Write labels at the first of some points (N, 3); an empty one is not written."""
    return [
        server.scene.add_label(
            f"/labels{name}/{row}", label, position=p[row].astype(np.float64), font_screen_scale=0.8
        )
        for row, label in enumerate(labels)
        if label
    ]


@functools.lru_cache(maxsize=16)
def _shuffle(count: int) -> I64:
    """Return an order of points whose beginnings are spread over all of them; `page.js` uses that."""
    return np.random.default_rng(0).permutation(count)


def _line_colours(colours: U8) -> U8:
    """Return colours (N, 2, 3) of both ends of lines (N,).

    viser takes the colours of lines for linear light and those of all else for sRGB.
    """
    linear = np.round(255.0 * linear_light(colours)).astype(np.uint8)
    return np.repeat(linear[:, None], 2, axis=1)


def _moved_in_place(server: viser.ViserServer, key: _NodeKey, node: _Node, part: Part) -> bool:
    """Give a node new positions, colours and labels where it can keep its shape."""
    before = node.part
    if not node.handles or len(before) != len(part):
        return False
    if isinstance(before, Points) and isinstance(part, Points) and before.size_m == part.size_m:
        order = _shuffle(len(part))
        if not np.array_equal(before.p, part.p):
            node.handles[0].points = part.p[order]
            labelled = [row for row, label in enumerate(before.labels) if label]
            for label, p in zip(node.handles[1:], part.p[labelled], strict=True):
                label.position = p.astype(np.float64)
        if not np.array_equal(before.colours, part.colours):
            node.handles[0].colors = part.colours[order]
        if before.labels != part.labels:
            for label in node.handles[1:]:
                label.remove()
            node.handles[1:] = _add_labels(server, _node_name(*key), part.labels, part.p)
    elif (
        isinstance(before, Segments)
        and isinstance(part, Segments)
        and before.width_px == part.width_px
    ):
        if not np.array_equal(before.ends, part.ends):
            node.handles[0].points = part.ends
        if not np.array_equal(before.colours, part.colours):
            node.handles[0].colors = _line_colours(part.colours)
    else:
        return False
    node.part = part
    return True


def _node_name(layer: str, mission_id: str) -> str:
    return f"/map/{layer}/{mission_id or 'all'}"


def is_coloured(mesh: Mesh) -> bool:
    """Tell whether the corners of a mesh have a colour each."""
    colour: U8 = mesh.colours
    return colour.ndim == 2


logger = logging.getLogger(__name__)


def update(widget: Any, **values: object) -> None:
    """Set the properties of a widget that differ: each is sent to all pages."""
    for name, value in values.items():
        if getattr(widget, name) != value:
            setattr(widget, name, value)


def by_user(
    lock: threading.RLock, action: Callable[[Any], None], say: Callable[[str], None]
) -> Callable[[Any], None]:
    """Make a callback: only for what a page does, one at a time; errors are said and logged."""

    def callback(event: Any) -> None:
        if getattr(event, "client_id", None) is None:
            return
        try:
            with lock:
                action(event)
        except Exception:
            logger.exception("the viewer could not do what a page asked for")
            with lock:
                say("this could not be done: the log file has the reason")

    return callback
