"""Selected entities of each page: their facts, frusta and rays, and the distance between two picks."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.landmarks.sightings import residuals
from maplab_py.array_types import F64, I64, U8, Rows
from maplab_py.errors import MapError, UserError
from maplab_py.viewer import colours, resource_clouds
from maplab_py.viewer.display import panel, parts
from maplab_py.viewer.display.camera import approach
from maplab_py.viewer.drawing import Drawing, make_points, make_segments
from maplab_py.viewer.facts import Facts, facts
from maplab_py.viewer.layers import cameras
from maplab_py.viewer.picking import MIN_DIGITS, Pick, ends_of, find_by_id, id_of
from maplab_py.viewer.scene import Entity, Part
from maplab_py.vimap import VIMap, descriptors, ragged_rows

if TYPE_CHECKING:
    from maplab_py.viewer.display.viewer import Viewer

_HINT = "Click a vertex, a landmark or a loop closure."
_MAX_FRUSTA = 16
"""More cameras of one landmark's observers would hide it."""


@dataclasses.dataclass(frozen=True, eq=False)
class _Content:
    """Facts and image of a selected entity."""

    facts: Facts
    image: U8 | None  # of a vertex, or both images of a closure
    note: str
    ends: tuple[int, ...]  # vertices (rows) of a closure


def _content(drawing: Drawing, picked: Pick) -> _Content:
    vi_map, images, ends = (
        drawing.vi_map,
        drawing.images,
        ends_of(drawing, picked.entity, picked.row),
    )
    image, note = None, ""
    if picked.entity is Entity.VERTEX:
        image = images(picked.row)
        if image is not None and isinstance(images, resource_clouds.VertexImages):
            image, note = with_keypoints(vi_map, image, images.frame(picked.row))
    elif ends and isinstance(images, resource_clouds.VertexImages):
        image, note = closure_picture(vi_map, images, *ends) or (None, "")
    return _Content(facts(vi_map, picked.entity, picked.row), image, note, ends)


class _Widgets:
    """Folder "Selection" as one page has it."""

    def __init__(self, page: Any, folder: Any) -> None:
        with folder:
            self.image = page.gui.add_image(np.zeros((8, 8, 3), dtype=np.uint8), visible=False)
            self.facts = page.gui.add_html(panel.hint(_HINT))
            self.jump = page.gui.add_text(
                "go to id", "", hint="beginning of the id of a vertex, landmark, closure or mission"
            )
            self.measuring = page.gui.add_checkbox(
                "measure", False, hint="measure the distance between two picks"
            )
            self.clear = page.gui.add_button("clear", visible=False)

    def show(self, shown: Facts, image: U8 | None, note: str) -> None:
        """Show facts; without any the hint, and the image that is there unless it is of a pick."""
        table = panel.fact_table(shown) if shown else panel.hint(_HINT)
        self.facts.content = (panel.hint(note) if note else "") + table
        if shown or self.clear.visible:
            self.show_image(image)
        self.clear.visible = bool(shown)

    def show_image(self, image: U8 | None) -> None:
        """Show an image (H, W, 3), or none."""
        if image is not None:
            self.image.image = image
        parts.update(self.image, visible=image is not None)


class Selection:
    """Selected entity of a page, and its marks in the scene; without a page, that of pages to come."""

    def __init__(self, page: Any = None, widgets: _Widgets | None = None) -> None:
        self._page = page
        self._widgets = widgets
        self._handles: list[Any] = []
        self._anchor: Pick | None = None  # the first of two picks to measure between
        self.is_measuring = False
        self.picked: Pick | None = None
        self.distance_m: float | None = None
        self.picture: U8 | None = None  # of the pick: an image, or both images of a closure

    def show(self, drawing: Drawing, picked: Pick, content: _Content) -> None:
        """Mark what was picked and show its facts."""
        previous, self.picked, self.distance_m = self.picked, picked, None
        self._clear_marks()
        self.picture, note = content.image, content.note
        if self.is_measuring and previous is not None:
            self._anchor = previous
            self.distance_m = float(np.linalg.norm(picked.p - previous.p))
            note = f"distance to the pick before: {self.distance_m:.3f} m"
        if self._page is not None:
            self._mark(drawing, picked, content.ends)
        if self._widgets is not None:
            self._widgets.show(content.facts, content.image, note)

    def clear(self) -> None:
        """Clear the pick."""
        self._clear_marks()
        self.picked = self._anchor = self.distance_m = None
        if self._widgets is not None:
            self._widgets.show((), None, "")

    def show_image(self, image: U8 | None) -> None:
        """Show an image (H, W, 3) that is not of the pick, or none."""
        if self._widgets is not None:
            self._widgets.show_image(image)

    def say(self, message: str) -> None:
        """Say in the place of the facts why nothing was selected."""
        if self._widgets is not None:
            self._widgets.facts.content = panel.hint(message)

    def _clear_marks(self) -> None:
        for handle in self._handles:
            handle.remove()
        self._handles = []

    def _mark(self, drawing: Drawing, picked: Pick, ends: tuple[int, ...]) -> None:
        size = 0.005 * drawing.unit_m
        row = np.array([picked.row])
        self._add("point", make_points(picked.p[None], colours.PICKED, row, size))
        if picked.entity is Entity.VERTEX:
            self._mark_vertex(drawing, picked.row)
        elif picked.entity is Entity.LANDMARK:
            start, end, vertices = cameras.observer_rays(drawing, picked.row)
            self._add("rays", make_segments(start, end, colours.PICKED, vertices, 1.0))
            observers = np.unique(vertices)
            every = -(-len(observers) // _MAX_FRUSTA)
            self._add_frusta(drawing, observers[::every], 0.015, 1.0)
        elif ends:
            rows = np.array(ends)
            p = drawing.p_vertices[rows]
            self._add("edge", make_segments(p[:1], p[1:], colours.PICKED, rows[:1], 6.0))
            self._add_frusta(drawing, rows, 0.05, 2.0)
        if self.distance_m is not None and self._anchor is not None:
            self._mark_distance(picked, self._anchor, self.distance_m, size)

    def _mark_vertex(self, drawing: Drawing, row: int) -> None:
        vi_map = drawing.vi_map
        self._add_frusta(drawing, np.array([row]), 0.05, 2.0)
        frames = np.arange(*vi_map.frame_start[row : row + 2])
        keypoints = ragged_rows(vi_map.keypoint_start, frames)
        landmark = vi_map.keypoints.landmark[keypoints]
        seen = (landmark >= 0) & (vi_map.landmarks.quality[landmark] != 1)
        centres, _ = cameras.camera_centres(drawing, keypoints[seen])
        rows = landmark[seen].astype(np.int64)
        rays = make_segments(centres, drawing.p_landmarks[rows], colours.PICKED, rows, 0.6)
        self._add("rays", rays)

    def _add_frusta(
        self, drawing: Drawing, vertices: NDArray[np.int64], size: float, width_px: float
    ) -> None:
        missions = drawing.vi_map.vertices.mission[vertices]
        lines = [
            cameras.frustum_lines(
                drawing, vertices[missions == mission], camera, size * drawing.unit_m
            )
            for mission in np.unique(missions).tolist()
            for camera in cameras.mission_cameras(drawing.vi_map, mission)
        ]
        if lines:
            ends = np.concatenate(lines)
            rows = np.arange(len(ends))
            part = make_segments(ends[:, 0], ends[:, 1], colours.PICKED, rows, width_px)
            self._add("frusta", part)

    def _mark_distance(self, picked: Pick, anchor: Pick, distance_m: float, size: float) -> None:
        row = np.array([0])
        self._add("anchor", make_points(anchor.p[None], colours.SECOND_PICK, row, size))
        line = make_segments(anchor.p[None], picked.p[None], colours.SECOND_PICK, row, 3.0)
        self._add("distance", line)
        middle = 0.5 * (anchor.p + picked.p)
        label = self._page.scene.add_label(
            "/pick/distance_label", f"{distance_m:.3f} m", position=middle
        )
        self._handles.append(label)

    def _add(self, name: str, part: Part) -> None:
        self._handles += parts.add_part(self._page, f"/pick/{name}", part)


class Selections:
    """Selections of all pages.

    A page selects for itself, the console for all pages and for those that will be opened.
    """

    def __init__(self, viewer: Viewer, folder: Any) -> None:
        """Give every page its widgets in a folder of the panel."""
        self._viewer, self._folder = viewer, folder
        self._general = Selection()
        self.pages: dict[int, Selection] = {}  # selections of open pages by their number
        self._live: U8 | None = None
        self.newest = self._general  # selection that was changed last
        self.on_pick: Callable[[str], None] = lambda _: None  # told the id of each pick
        viewer.server.on_client_connect(self._open)
        viewer.server.on_client_disconnect(self._close)

    def of(self, page: Any) -> Selection:
        """Return the selection of a page, which begins as the console's."""
        key = getattr(page, "client_id", None)
        if key is None:
            return self._general
        if key not in self.pages:
            self.pages[key] = selection = Selection(page, self._make_widgets(page))
            selection.is_measuring, picked = self._general.is_measuring, self._general.picked
            if picked is not None:
                drawing = self._viewer.drawing
                selection.show(drawing, picked, _content(drawing, picked))
            elif self._live is not None:
                selection.show_image(self._live)
        return self.pages[key]

    def pick(self, drawing: Drawing, picked: Pick, page: Any = None) -> None:
        """Select in a page, None = in all."""
        content = _content(drawing, picked)
        if page is None:
            self._in_all(lambda selection: selection.show(drawing, picked, content))
        else:
            self.of(page).show(drawing, picked, content)
        self.newest = self._general if page is None else self.of(page)
        self.on_pick(id_of(drawing.vi_map, picked))

    def jump(self, drawing: Drawing, text: str, page: Any = None) -> Pick:
        """Select what an id means in a page, None = in all.

        Raises:
            UserError: Nothing has an id that starts so, or several have.
        """
        picked = find_by_id(drawing, text)
        self.pick(drawing, picked, page)
        return picked

    def clear(self) -> None:
        """Clear the picks of all pages."""
        self._in_all(Selection.clear)
        self.newest = self._general

    def set_measuring(self, is_measuring: bool) -> None:
        """Measure between the picks of each page, or not."""
        for selection in (self._general, *self.pages.values()):
            selection.is_measuring = is_measuring

    def show_image(self, image: U8 | None) -> None:
        """Show an image (H, W, 3), or none, in all pages, as of a recording that runs."""
        with self._viewer.lock:
            self._live = image
            self._in_all(lambda selection: selection.show_image(image))

    def _in_all(self, change: Callable[[Selection], None]) -> None:
        """Change the selections of all pages but those that close meanwhile."""
        change(self._general)
        for key, selection in tuple(self.pages.items()):
            try:
                change(selection)
            except RuntimeError:  # a widget has gone with its page
                if key in self._viewer.server.get_clients():
                    raise

    def _open(self, page: Any) -> None:
        with self._viewer.lock:
            if page.client_id in self._viewer.server.get_clients():  # else it has left already
                self.of(page)

    def _close(self, page: Any) -> None:
        with self._viewer.lock:
            self.pages.pop(page.client_id, None)

    def _make_widgets(self, page: Any) -> _Widgets:
        widgets = _Widgets(page, self._folder)

        def measure(event: Any) -> None:
            self.of(page).is_measuring = event.target.value

        for widget, action in ((widgets.jump, self._go), (widgets.measuring, measure)):
            widget.on_update(self._viewer.by_user(action))
        widgets.clear.on_click(self._viewer.by_user(lambda _: self.of(page).clear()))
        return widgets

    def _go(self, event: Any) -> None:
        """Go where an id is as soon as it is long enough: the page sends every key."""
        text, selection = event.target.value, self.of(event.client)
        if len(text.strip()) < MIN_DIGITS:
            return
        drawing = self._viewer.drawing
        try:
            picked = self.jump(drawing, text, event.client)
        except UserError as error:
            selection.say(str(error))
        else:
            fly(event.client, drawing, picked)


def fly(page: Any, drawing: Drawing, picked: Pick) -> None:
    """Move the camera of a page to what was picked."""
    with page.atomic():
        approach(page.camera, picked.p, 0.25 * drawing.extent.radius_m)


_LARGE_ERROR_PX = 3.0


def with_keypoints(vi_map: VIMap, image: U8, frame: int) -> tuple[U8, str]:
    """Return the image (H, W, 3) with its tracked keypoints as rings, and the meaning of their colours.

    The keypoints are those of a frame (row), -1 = none.
    """
    keypoints = np.arange(*vi_map.keypoint_start[frame : frame + 2]) if frame >= 0 else np.arange(0)
    keypoints = keypoints[vi_map.keypoints.landmark[keypoints] >= 0]
    if not len(keypoints):
        return image, ""
    try:
        p_G = vi_map.p_G[vi_map.keypoints.landmark[keypoints]]
        error_px = residuals(vi_map, keypoints, p_G).error_px
    except MapError:
        return image, ""  # no calibrated camera
    radius = max(2, round(image.shape[1] / 160))
    width = max(1, round(image.shape[1] / 640))
    y, x = np.mgrid[-radius - 1 : radius + 2, -radius - 1 : radius + 2]
    ring = np.abs(np.hypot(x, y) - radius) <= 0.5 * width + 0.3
    around = np.stack([x[ring], y[ring]], axis=1)
    places = np.floor(vi_map.keypoints.uv_px[keypoints]).astype(np.int64)[:, None] + around
    size = image.shape[1], image.shape[0]
    is_inside = np.asarray((places >= 0) & (places < size)).all(axis=2)
    part = np.minimum(error_px / _LARGE_ERROR_PX, 1.0)
    colour = np.broadcast_to(
        colours.ramp(1.0 - part, colours.TRUST)[:, None], (*is_inside.shape, 3)
    )
    drawn = image.copy()
    u, v = places[is_inside].T
    drawn[v, u] = colour[is_inside]
    words = (
        f"{len(keypoints)} tracked keypoints, green to red: 0 to {_LARGE_ERROR_PX:g} px of error"
    )
    return drawn, words


_MAX_BIT_FRACTION = 0.2
"""Bits in which the descriptors of a match may differ, as a part of all."""
_COLOUR = (255, 153, 0)
_GAP_PX = 6


class Matches(Rows):
    """Keypoints of two images that show the same point."""

    first: I64  # (N,) rows
    second: I64  # (N,)
    are_landmarks: bool  # both observe one landmark; else their descriptors are alike

    @property
    def note(self) -> str:
        """Meaning of the lines between both images."""
        what = "landmarks in common" if self.are_landmarks else "pairs of similar descriptors"
        return f"{len(self)} {what} in these images"


def closure_picture(
    vi_map: VIMap, images: resource_clouds.VertexImages, query: int, place: int
) -> tuple[U8, str] | None:
    """Return a picture (H, W, 3) RGB of two vertices (rows) with their matches, and what it shows.

    Args:
        query: Vertex at the left.
        place: Vertex at the right.

    Returns:
        None if the map has not both images.
    """
    left, right = images.image(query), images.image(place)
    frames = images.frame(query), images.frame(place)
    if left is None or right is None:
        return None
    matches = matches_of_frames(vi_map, *frames)
    height = max(left.shape[0], right.shape[0])
    offset = left.shape[1] + _GAP_PX
    canvas = np.full((height, offset + right.shape[1], 3), 255, dtype=np.uint8)
    canvas[: left.shape[0], : left.shape[1]] = left
    canvas[: right.shape[0], offset:] = right
    start = vi_map.keypoints.uv_px[matches.first]
    end = vi_map.keypoints.uv_px[matches.second] + [offset, 0.0]
    _draw(canvas, start, end)
    return canvas, matches.note


def matches_of_frames(vi_map: VIMap, first: int, second: int) -> Matches:
    """Return the keypoints of two frames (rows) that observe one landmark.

    Closures that are refused merge no landmarks. If both frames have none in common, these are the
    keypoints whose descriptors are mutually nearest and similar.
    """
    a, b = (
        np.arange(*vi_map.keypoint_start[frame : frame + 2], dtype=np.int64)
        for frame in (first, second)
    )
    landmark = vi_map.keypoints.landmark
    a_seen, b_seen = a[landmark[a] >= 0], b[landmark[b] >= 0]
    _, rows_a, rows_b = np.intersect1d(landmark[a_seen], landmark[b_seen], return_indices=True)
    if len(rows_a):
        return Matches(a_seen[rows_a], b_seen[rows_b], are_landmarks=True)
    sizes = descriptors.binary_descriptor_sizes(vi_map.frames)
    size = int(sizes[a].max(initial=0))
    a, b = a[sizes[a] == size], b[sizes[b] == size]
    if not size or not len(a) or not len(b):
        return Matches(a[:0], b[:0], are_landmarks=True)
    words = (np.ascontiguousarray(vi_map.keypoints.descriptor[rows, :size]) for rows in (a, b))
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(*words)
    table = np.array([(m.queryIdx, m.trainIdx, m.distance) for m in pairs]).reshape(-1, 3)
    near = table[table[:, 2] <= _MAX_BIT_FRACTION * 8 * size].astype(np.int64)
    return Matches(a[near[:, 0]], b[near[:, 1]], are_landmarks=False)


def _draw(canvas: U8, start: F64, end: F64) -> None:
    """Draw lines between points (N, 2) [px] and dots at their ends."""
    width = max(1, round(canvas.shape[1] / 900))
    ends = np.round(np.stack([start, end], axis=1)).astype(np.int32)
    cv2.polylines(canvas, list(ends), isClosed=False, color=_COLOUR, thickness=width)
    for x, y in ends.reshape(-1, 2).tolist():
        cv2.circle(canvas, (x, y), 3 * width, _COLOUR, width)
