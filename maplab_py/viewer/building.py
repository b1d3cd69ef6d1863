"""Conversion of a map to a scene."""

from __future__ import annotations

import dataclasses
from typing import Literal

import numpy as np

from maplab_py.algorithms.map_update.options import Change
from maplab_py.array_types import F64
from maplab_py.errors import UserError
from maplab_py.interop.trajectories import Trajectory
from maplab_py.viewer import colours, extension
from maplab_py.viewer.drawing import Drawing, ImageOf, make_drawing, no_image, spread_rows
from maplab_py.viewer.history import State
from maplab_py.viewer.layers import (
    cameras,
    changes,
    closures,
    clouds,
    comparison,
    covariances,
    landmarks,
    paths,
    references,
)
from maplab_py.viewer.layers.clouds import Cloud
from maplab_py.viewer.options import VisualizationOptions
from maplab_py.viewer.scene import WHOLE_MAP, Axes, Extent, Layer, MissionEntry, Scene
from maplab_py.vimap import VIMap, queries

_MAX_RAYS = 60_000
_OUTLINE_POINTS = 1500


Arrangement = Literal["over", "beside", "swipe"]
"""Another map over the map in grey, beside it, or left of a line that the page swipes over both."""
_WHERE = {"over": "in grey", "beside": "beside it", "swipe": "left of the line"}


@dataclasses.dataclass(frozen=True, eq=False)
class Subject:
    """Subject of a view: a map and the references to compare it with."""

    vi_map: VIMap
    title: str = "map"
    options: VisualizationOptions = dataclasses.field(default_factory=VisualizationOptions)
    other: VIMap | None = None
    other_name: str = "before"
    arrangement: Arrangement = "over"  # of the other map
    truth: Trajectory | None = None
    clouds: tuple[Cloud, ...] = ()
    segments: references.MarkedSegments | None = None
    localized: paths.LocalizedRun | None = None
    changes: tuple[Change, ...] = ()  # of a later session
    shows_observers: bool = False
    shows_sensors: bool = False  # the mounting of the sensors, and nothing of the map
    only_layers: tuple[str, ...] = ()  # visible at first; empty = the default of each layer
    note: str = ""  # a line above the layers
    history: tuple[State, ...] = ()  # of the map, which is one of them
    images: ImageOf = no_image  # of the vertices of the map
    state: int = -1  # place in the history of what is shown; -1 = the map

    @property
    def shown(self) -> VIMap:
        """State of the map that is drawn."""
        return self.vi_map if self.state < 0 else self.history[self.state].vi_map

    @property
    def place(self) -> int:
        """Place in the history of what is drawn, left of a swipe line if there is one; -1 = it has none."""
        shown = self.shown if self.other is None or self.arrangement != "swipe" else self.other
        return next((i for i, state in enumerate(self.history) if state.vi_map is shown), -1)

    def at_state(self, place: int, *, swipes: bool) -> Subject:
        """Return the subject with a state of the history in place of the map, or left of a swipe line."""
        state = self.history[place]
        if swipes:
            name = state.command or "before the first command"
            return self.replace(state=-1, other=state.vi_map, other_name=name, arrangement="swipe")
        if self.arrangement == "swipe":
            return self.replace(state=place, other=None, arrangement="over")
        return self.replace(state=place)

    def replace(self, **exchanged: object) -> Subject:
        """Return the subject with some of it exchanged."""
        return dataclasses.replace(self, **exchanged)  # type: ignore[arg-type]


def build_scene(subject: Subject) -> Scene:
    """Return everything that is drawn of a map; layers without content are omitted.

    Raises:
        UserError: The map has no vertices, or the ground truth does not fit it.
    """
    return scene_of(make_checked_drawing(subject), subject)


def make_checked_drawing(subject: Subject) -> Drawing:
    """Return the drawing of a subject.

    Raises:
        UserError: The map has no vertices, or no sensors where those are to be shown.
    """
    if subject.shows_sensors:
        return _sensor_drawing(subject)
    if not len(subject.shown.vertices):
        raise UserError(f"map '{subject.title}' has no vertices: there is nothing to show")
    drawing = make_drawing(subject.shown, subject.options)
    drawing = dataclasses.replace(drawing, images=subject.images)
    # the vertices of another state may have other rows
    images = drawing.of_state(subject.shown).images
    return (
        drawing if subject.shown is subject.vi_map else dataclasses.replace(drawing, images=images)
    )


def scene_of(drawing: Drawing, subject: Subject) -> Scene:
    """Return the scene of a drawing."""
    if subject.shows_sensors:
        layer = cameras.sensor_axes(subject.vi_map.sensors)
        return Scene(subject.title, (layer,), (), drawing.extent, drawing.origin_G)
    layers: list[Layer] = [
        paths.trajectories(drawing),
        paths.vertices(drawing),
        dataclasses.replace(paths.path_ends(drawing), is_visible=not subject.changes),
    ]
    layers += landmarks.landmarks(drawing)
    layers += [paths.loop_closures(drawing), paths.absolute_poses(drawing)]
    layers += covariances.covariance_layers(drawing)
    layers += [cameras.frusta(drawing), paths.imu_edges(drawing)]
    layers += [*paths.transformation_edges(drawing), paths.base_frames(drawing)]
    if subject.segments is not None:
        layers.append(references.marked_segments(drawing, subject.segments))
    if subject.shows_observers:
        rows = _good_landmarks(drawing)
        layers.append(cameras.landmark_observers(drawing, rows, _MAX_RAYS))
    layers += changes.change_layers(drawing, subject.changes)
    layers += clouds.layers_of_clouds(drawing, subject.clouds)
    if subject.localized is not None:
        layers += paths.localized_layers(drawing, subject.localized)
    if subject.truth is not None:
        layers += references.ground_truth(drawing, subject.truth)
    if subject.other is not None:
        layers += _layers_of_other(drawing, subject, subject.other)
    remembered, unreadable = closures.recorded_closures(drawing)
    layers += remembered
    if subject.options.coverage:
        from maplab_py.viewer.layers.coverage import coverage_layers

        more, unknown = coverage_layers(drawing)
        layers, unreadable = layers + more, unreadable + unknown
    added, problems = extension.plugin_layers(drawing, {layer.name for layer in layers})
    layers += added
    layers = [_with_visibility(layer, subject) for layer in layers if layer.total]
    extent = drawing.extent
    if subject.localized is not None:
        extent = _widen(extent, subject.localized.p_G - drawing.origin_G)
    notes = [note for layer in layers if not layer.choices for note in layer.notes]
    notes = [*filter(None, [subject.note]), *notes, *unreadable, *problems]
    if subject.other is not None:
        is_beside = subject.arrangement == "beside"
        extent = _with_reference(drawing, subject.other, side_by_side=is_beside)
        notes.insert(0, f"{_WHERE[subject.arrangement]}: {subject.other_name}")
    return Scene(
        subject.title, tuple(layers), mission_entries(drawing), extent, drawing.origin_G,
        notes=tuple(notes),
    )  # fmt: skip


def _layers_of_other(drawing: Drawing, subject: Subject, other: VIMap) -> list[Layer]:
    if subject.arrangement == "beside":
        return comparison.beside(drawing, other, (subject.title, subject.other_name))
    if subject.arrangement == "swipe":
        return comparison.swiped(drawing, other)
    return references.compared(drawing, other)


def _with_reference(drawing: Drawing, other: VIMap, *, side_by_side: bool) -> Extent:
    """Return the extent of the map together with the path of another state of it."""
    shift = comparison.shift_beside(drawing, other) if side_by_side else -drawing.origin_G
    return _widen(drawing.extent, other.T_G_I[:, 4:] + shift)


def _widen(extent: Extent, p: F64) -> Extent:
    """Return an extent that has points (N, 3), too."""
    p = p[np.isfinite(p).all(axis=1)]
    outline = np.concatenate([extent.outline, p[spread_rows(p, _OUTLINE_POINTS)]])
    low, high = outline.min(axis=0), outline.max(axis=0)
    radius = max(0.5 * float(np.linalg.norm(high - low)), extent.radius_m)
    return Extent(0.5 * (low + high), radius, extent.floor_m, outline)


def mission_entries(drawing: Drawing) -> tuple[MissionEntry, ...]:
    """Return the missions as the panel lists them."""
    vi_map = drawing.vi_map
    span_s = 1e-9 * np.diff(queries.mission_time_spans_ns(vi_map), axis=1)[:, 0]
    length_m = queries.mission_distances_m(vi_map)
    codes = colours.hex_codes(drawing.mission_colours)
    known = vi_map.baseframes.is_known[vi_map.missions.baseframe]
    counts = np.diff(vi_map.vertex_start)
    return tuple(
        MissionEntry(
            mission_id, drawing.mission_names[row], codes[row], int(counts[row]),
            float(length_m[row]), float(span_s[row]), bool(known[row]),
        )
        for row, mission_id in enumerate(drawing.mission_ids)
    )  # fmt: skip


def _with_visibility(layer: Layer, subject: Subject) -> Layer:
    if not subject.only_layers:
        return layer
    return dataclasses.replace(layer, is_visible=layer.name in subject.only_layers)


def _sensor_drawing(subject: Subject) -> Drawing:
    """Return a drawing whose extent is that of the sensors on their base."""
    layer = cameras.sensor_axes(subject.vi_map.sensors)
    axes = layer.parts[WHOLE_MAP]
    if not isinstance(axes, Axes) or not len(axes):
        raise UserError(f"map '{subject.title}' has no sensors")
    p = axes.T[:, 4:]
    low, high = p.min(axis=0) - axes.length_m, p.max(axis=0) + axes.length_m
    radius = 0.5 * float(np.linalg.norm(high - low))
    outline = np.concatenate([p - axes.length_m, p + axes.length_m])
    extent = Extent(0.5 * (low + high), radius, float(low[2]), outline)
    return Drawing(subject.vi_map, subject.options, np.zeros(3), extent)


def _good_landmarks(drawing: Drawing) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
    table = drawing.vi_map.landmarks
    return np.flatnonzero((table.quality != 1) & np.isfinite(drawing.p_landmarks).all(axis=1))
