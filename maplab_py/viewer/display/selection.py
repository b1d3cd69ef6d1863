"""Selected entities: their facts, frusta and rays, and the distance between two picks."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import viser
from numpy.typing import NDArray

from maplab_py.algorithms.landmarks.sightings import residuals
from maplab_py.algorithms.loop_closure.closure_record import read_record
from maplab_py.array_types import F64, I64, U8
from maplab_py.errors import MapError
from maplab_py.viewer import colours
from maplab_py.viewer.display.camera import approach
from maplab_py.viewer.display.panel import Panel
from maplab_py.viewer.display.parts import add_part
from maplab_py.viewer.drawing import Drawing, make_points, make_segments
from maplab_py.viewer.facts import facts
from maplab_py.viewer.layers import cameras
from maplab_py.viewer.layers.closures import closure_ends
from maplab_py.viewer.picking import Pick, find_by_id, id_of
from maplab_py.viewer.resource_clouds import VertexImages
from maplab_py.viewer.scene import Entity, Part
from maplab_py.vimap import VIMap, ragged_rows
from maplab_py.vimap.descriptors import binary_descriptor_sizes

_MAX_FRUSTA = 16
"""More cameras of one landmark's observers would hide it."""


class Selection:
    """The picked thing and its marks in the scene."""

    def __init__(self, server: viser.ViserServer, panel: Panel) -> None:
        """Start with nothing picked."""
        self._server = server
        self._panel = panel
        self._handles: list[Any] = []
        self._anchor: Pick | None = None  # the first of two picks to measure between
        self._ends: tuple[int, ...] = ()  # vertices (rows) of the picked closure
        self.is_measuring = False
        self.picked: Pick | None = None
        self.distance_m: float | None = None
        self.picture: U8 | None = None  # of the pick: an image, or both images of a closure
        self.on_pick: Callable[[str], None] = lambda _: None  # told the id of each pick

    def pick(self, drawing: Drawing, picked: Pick) -> None:
        """Mark what was clicked and show its facts."""
        previous, self.picked, self.distance_m = self.picked, picked, None
        self.on_pick(id_of(drawing.vi_map, picked))
        self._clear_marks()
        self._ends = ()
        note = ""
        if self.is_measuring and previous is not None:
            self._anchor = previous
            self.distance_m = float(np.linalg.norm(picked.p - previous.p))
            note = f"distance to the pick before: {self.distance_m:.3f} m"
        self._mark(drawing, picked)
        image = None
        if picked.entity is Entity.VERTEX:
            image = drawing.images(picked.row)
            if image is not None and isinstance(drawing.images, VertexImages):
                image, words = with_keypoints(
                    drawing.vi_map, image, drawing.images.frame(picked.row)
                )
                note = note or words
        elif self._ends and isinstance(drawing.images, VertexImages):
            pair = closure_picture(drawing.vi_map, drawing.images, *self._ends)
            image, note = pair or (None, note)
        self.picture = image
        self._panel.show_facts(facts(drawing.vi_map, picked.entity, picked.row), image, note)

    def jump(self, drawing: Drawing, text: str, clients: list[Any]) -> None:
        """Pick what an id means, and move the cameras of pages there.

        Raises:
            UserError: Nothing has an id that starts so, or several have.
        """
        picked = find_by_id(drawing, text)
        self.pick(drawing, picked)
        for client in clients:
            with client.atomic():
                approach(client.camera, picked.p, 0.25 * drawing.extent.radius_m)

    def clear(self) -> None:
        """Clear the pick."""
        self._clear_marks()
        self.picked = self._anchor = self.distance_m = None
        self._panel.show_facts((), None)

    def _clear_marks(self) -> None:
        for handle in self._handles:
            handle.remove()
        self._handles = []

    def _mark(self, drawing: Drawing, picked: Pick) -> None:
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
        elif picked.entity is Entity.LOOP_CLOSURE:
            edges = drawing.vi_map.loop_closure_edges
            ends = np.array([edges.from_vertex[picked.row], edges.to_vertex[picked.row]])
            self._mark_closure(drawing, ends.astype(np.int64))
        elif picked.entity is Entity.CLOSURE:
            record = read_record(drawing.vi_map).closures.take(row)
            self._mark_closure(drawing, np.concatenate(closure_ends(drawing, record)))
        if self.distance_m is not None and self._anchor is not None:
            self._mark_distance(picked, self._anchor, self.distance_m, size)

    def _mark_closure(self, drawing: Drawing, ends: NDArray[np.int64]) -> None:
        self._ends = tuple(ends.tolist())
        p = drawing.p_vertices[ends]
        self._add("edge", make_segments(p[:1], p[1:], colours.PICKED, ends[:1], 6.0))
        self._add_frusta(drawing, ends, 0.05, 2.0)

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
        label = self._server.scene.add_label(
            "/pick/distance_label", f"{distance_m:.3f} m", position=middle
        )
        self._handles.append(label)

    def _add(self, name: str, part: Part) -> None:
        self._handles += add_part(self._server, f"/pick/{name}", part)


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


@dataclasses.dataclass(frozen=True, eq=False)
class Matches:
    """Keypoints of two images that show the same point."""

    first: I64  # (N,) rows
    second: I64  # (N,)
    are_landmarks: bool  # both observe one landmark; else their descriptors are alike

    def __len__(self) -> int:
        return len(self.first)

    @property
    def note(self) -> str:
        """Meaning of the lines between both images."""
        what = "landmarks in common" if self.are_landmarks else "pairs of similar descriptors"
        return f"{len(self)} {what} in these images"


def closure_picture(
    vi_map: VIMap, images: VertexImages, query: int, place: int
) -> tuple[U8, str] | None:
    """Return a picture (H, W, 3) RGB of two vertices (rows) with their matches, and what it shows.

    Args:
        vi_map: The map.
        images: Its images.
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
    sizes = binary_descriptor_sizes(vi_map.frames)
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
