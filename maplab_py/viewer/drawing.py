"""Data shared by all layers of a drawing: the map, its colours, and the scene's origin."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cached_property
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from maplab_py.array_types import F32, F64, I64, U8, U64, Mask
from maplab_py.geometry import so3
from maplab_py.viewer import colours
from maplab_py.viewer.options import VisualizationOptions
from maplab_py.viewer.scene import Extent, Points, Scene, Segments
from maplab_py.vimap import VIMap, mission_labels, to_hex_list

ImageOf = Callable[[int], "U8 | None"]
"""Gives the image (H, W, 3) of a vertex (row), if there is one."""


def no_image(row: int) -> None:  # noqa: ARG001
    """Say that a vertex has no image."""
    return


@runtime_checkable
class MapImages(Protocol):
    """Images of the vertices of a map that other states of it share."""

    def of_map(self, vi_map: VIMap) -> ImageOf:
        """Return the images of another state of the map."""
        ...

    def pixels(self) -> tuple[U8, Mask]:
        """Return the colours (L, 3) of landmarks, and which of them are known (L,)."""
        ...


_LEAST_RADIUS_M = 0.02
"""Radius that a map is drawn as if it had at least, before its device moves."""
_OUTLINE_POINTS = 1500
_FAR_M = 2000.0
"""Beyond this distance from the origin of G float32 would cost more than 0.1 mm."""


@dataclasses.dataclass(frozen=True, eq=False)
class Drawing:
    """A map about to be drawn."""

    vi_map: VIMap
    options: VisualizationOptions
    origin_G: F64  # (3,)
    extent: Extent
    images: ImageOf = no_image

    def of_state(self, vi_map: VIMap) -> Drawing:
        """Return the drawing of another state of the map, or of another map, where this one is."""
        images = self.images.of_map(vi_map) if isinstance(self.images, MapImages) else no_image
        return Drawing(vi_map, self.options, self.origin_G, self.extent, images)

    @cached_property
    def mission_ids(self) -> list[str]:
        """Ids of all missions."""
        return to_hex_list(self.vi_map.missions.id)

    @cached_property
    def mission_names(self) -> list[str]:
        """Labels of all missions, as in the console: names, else beginnings of ids."""
        return mission_labels(self.vi_map)

    @cached_property
    def mission_colours(self) -> U8:
        """Colours (M, 3)."""
        names = list(self.vi_map.missions.name)
        every = colours.mission_colours(len(names), self.options.color_salt)
        if not self.options.color_missions_by_name:
            return every
        return every[[names.index(name) if name else row for row, name in enumerate(names)]]

    @cached_property
    def shift(self) -> F64:
        """Offsets (M, 3) that take positions of each mission from G to the scene."""
        return mission_shift(self.vi_map, self.options) - self.origin_G

    @cached_property
    def p_vertices(self) -> F64:
        """Positions (V, 3) of the vertices in the scene."""
        return self.vi_map.T_G_I[:, 4:] + self.shift[self.vi_map.vertices.mission]

    @cached_property
    def landmark_mission(self) -> NDArray[np.int32]:
        """Mission row (L,) of each landmark."""
        return self.vi_map.vertices.mission[self.vi_map.landmarks.vertex]

    @cached_property
    def p_landmarks(self) -> F64:
        """Positions (L, 3) of the landmarks in the scene."""
        p = self.vi_map.p_G + self.shift[self.landmark_mission]
        offset_m = self.options.offset_landmarks_by_first_observer_frame_m
        if offset_m:
            p[:, 0] += offset_m * np.maximum(first_camera(self.vi_map), 0)
        return p

    @property
    def unit_m(self) -> float:
        """Length that looks the same in a map of any size.

        It goes in steps of a fifth, so that a small change of the map leaves the sizes of all
        points as they are, and they need not be sent again.
        """
        step = np.round(4.0 * np.log2(self.extent.radius_m)) / 4.0
        return float(2.0**step) * self.options.scale

    def by_mission(self, mission: NDArray[Any]) -> list[tuple[str, I64]]:
        """Return the mission ids that occur in (N,) mission rows, with the places of each."""
        groups = rows_by_value(mission, np.arange(len(mission)))
        return [(self.mission_ids[row], places) for row, places in groups.items()]

    def points(
        self, mission: NDArray[Any], p: F64, colour: U8, rows: I64, size_m: float
    ) -> dict[str, Points]:
        """Return points (N, 3) in a colour each (N, 3) by the missions (N,) that they are of."""
        return {
            mission_id: make_points(p[places], colour[places], rows[places], size_m)
            for mission_id, places in self.by_mission(mission)
        }

    def segments(
        self,
        mission: NDArray[Any],
        start: F64,
        end: F64,
        colour: U8,
        rows: I64,
        width_px: float,
    ) -> dict[str, Segments]:
        """Return lines (N,) in one colour (3,) or one each (N, 3) by the missions that they are of."""
        every = np.broadcast_to(colour, start.shape)
        return {
            mission_id: make_segments(start[k], end[k], every[k], rows[k], width_px)
            for mission_id, k in self.by_mission(mission)
        }


def rows_by_value(values: NDArray[Any], rows: I64) -> dict[int, I64]:
    """Return the rows (N,) by their values (N,), ascending."""
    order = np.argsort(values, kind="stable")
    cuts = np.flatnonzero(np.diff(values[order])) + 1
    groups = np.split(order, cuts) if len(order) else []
    return {int(values[group[0]]): rows[group] for group in groups}


def mission_shift(vi_map: VIMap, options: VisualizationOptions) -> F64:
    """Return by how much each mission (M, 3) is drawn away from where it is [m]."""
    shift = np.tile(
        [options.offset_x_m, options.offset_y_m, options.offset_z_m], (len(vi_map.missions), 1)
    )
    distance = options.spatially_distribute_missions_meters
    shift[:, 0] += distance * np.arange(len(vi_map.missions))
    return shift


def make_drawing(vi_map: VIMap, options: VisualizationOptions) -> Drawing:
    """Find origin and extent of a map."""
    shift = mission_shift(vi_map, options)
    path = _finite(vi_map.T_G_I[:, 4:] + shift[vi_map.vertices.mission])
    if not len(path):
        path = np.zeros((1, 3))
    low, high = path.min(axis=0), path.max(axis=0)
    origin = np.round(0.5 * (low + high), -3)
    if np.abs(0.5 * (low + high)).max() < _FAR_M:
        origin = np.zeros(3)
    landmarks = _finite(vi_map.p_G + shift[vi_map.vertices.mission[vi_map.landmarks.vertex]])
    return Drawing(vi_map, options, origin, _extent(path - origin, landmarks - origin))


def _extent(path: F64, landmarks: F64) -> Extent:
    """Return the extent of the path (N, 3) and of most landmarks (M, 3).

    The outermost tenth of the landmarks does not count, nor one much further away than the path is large
    and than most landmarks are: a device that stands still sees a room around a path of no length.
    """
    low, high = path.min(axis=0), path.max(axis=0)
    away_m = np.abs(landmarks - 0.5 * (low + high)).max(axis=1)
    usual_m = float(np.median(away_m)) if len(away_m) else 0.0
    near = landmarks[away_m < 2.5 * max(float(np.linalg.norm(high - low)), usual_m, 1.0)]
    outline = path
    if len(near) >= 20:
        lowest, highest = np.percentile(near, [5.0, 95.0], axis=0)
        inner = near[np.all((near >= lowest) & (near <= highest), axis=1)]
        low, high = np.minimum(low, lowest), np.maximum(high, highest)
        outline = np.concatenate([path, inner])
    outline = outline[spread_rows(outline, _OUTLINE_POINTS)]
    radius = max(0.5 * float(np.linalg.norm(high - low)), _LEAST_RADIUS_M)
    return Extent(0.5 * (low + high), radius, float(low[2]), outline)


def _finite(p: F64) -> F64:
    return np.asarray(p[np.isfinite(p).all(axis=1)])


def make_points(p: F64, colour: U8, rows: I64, size_m: float) -> Points:
    """Return a cloud of points (N, 3) in one colour (3,) or one each (N, 3), finite ones only."""
    every = np.broadcast_to(colour, (len(p), 3))
    points = Points(p.astype(np.float32), every, rows.astype(np.int64), size_m)
    return points.take(np.flatnonzero(np.isfinite(p).all(axis=1)))


def make_segments(start: F64, end: F64, colour: U8, rows: I64, width_px: float = 1.5) -> Segments:
    """Return lines from (N, 3) to (N, 3) in one colour (3,) or one each (N, 3), finite ones only."""
    ends = np.stack([start, end], axis=1)
    every = np.broadcast_to(colour, (len(ends), 3))
    segments = Segments(ends.astype(np.float32), every, rows.astype(np.int64), width_px)
    return segments.take(np.flatnonzero(np.isfinite(ends).all(axis=(1, 2))))


def axis_lines(T: F64, rows: I64, length_m: float, width_px: float = 2.0) -> Segments:
    """Return the x, y and z axes of poses (N, 7) of the scene as three lines each."""
    tips = length_m * so3.to_matrix(T[:, :4]).transpose(0, 2, 1)  # (N, axis, 3)
    start = np.repeat(T[:, 4:], 3, axis=0)
    every = np.tile(colours.AXES, (len(T), 1))
    return make_segments(start, start + tips.reshape(-1, 3), every, np.repeat(rows, 3), width_px)


def first_observation(vi_map: VIMap) -> I64:
    """Return the first observing keypoint row (L,) of each landmark in its mission, else any; or -1."""
    keypoint = vi_map.observations
    landmark = vi_map.keypoints.landmark[keypoint]
    home = vi_map.vertices.mission[vi_map.landmarks.vertex]
    is_foreign = vi_map.vertices.mission[vi_map.keypoint_vertex[keypoint]] != home[landmark]
    order = np.lexsort((keypoint, is_foreign, landmark))[::-1]
    first = np.full(len(vi_map.landmarks), -1, dtype=np.int64)
    first[landmark[order]] = keypoint[order]
    return first


def first_observer(vi_map: VIMap) -> I64:
    """Return the first observing vertex row (L,) of each landmark in its mission, else any; or -1."""
    first = first_observation(vi_map)
    vertex = np.full(len(first), -1, dtype=np.int64)
    vertex[first >= 0] = vi_map.keypoint_vertex[first[first >= 0]]
    return vertex


def first_camera(vi_map: VIMap) -> I64:
    """Return the index (L,) of the camera that observed each landmark first, -1 where none did."""
    first = first_observation(vi_map)
    camera = np.full(len(first), -1, dtype=np.int64)
    camera[first >= 0] = vi_map.frames.camera_index[vi_map.keypoint_frame[first[first >= 0]]]
    return camera


BAD_QUALITY = "of bad quality"
MAX_POINTS = "by --vis_max_points"
NO_POSITION = "without a finite position"


def omission_notes(title: str, drawn: int, *reasons: tuple[int, str]) -> tuple[str, ...]:
    """Return a line that says how many elements each reason leaves out; nothing if none does.

    Args:
        drawn: The number of elements that are drawn.
        reasons: How many elements are left out, and why.
    """
    active = [(count, words) for count, words in reasons if count > 0]
    if not active:
        return ()
    total = drawn + sum(count for count, _ in active)
    causes = ", ".join(f"{count:,} {words}" for count, words in active)
    return (f"{title}: {drawn:,} of {total:,} are drawn (left out: {causes})",)


_BITS = 16
"""Levels of the octree: voxels of 1 / 65536 of the cloud's width."""


def spread_rows(p: F64, limit: int) -> I64:
    """Return at most `limit` rows of points (N, 3), spread evenly over the space they fill.

    Points are sorted along a Z-order curve. Of the finest octree level with no more occupied
    voxels than `limit`, the first point of each voxel is taken; the rest is filled up with every
    n-th of the others, so that dense places stay denser. The same input gives the same rows.
    """
    if len(p) <= limit:
        return np.arange(len(p), dtype=np.int64)
    key = _z_order(p)
    order = np.argsort(key, kind="stable")
    key = key[order]
    taken = np.zeros(len(p), dtype=np.bool_)
    for level in range(_BITS, -1, -1):
        voxel = key >> np.uint64(3 * level)
        first = np.append(True, voxel[1:] != voxel[:-1])
        if np.count_nonzero(first) > limit:
            break
        taken = first
    others = np.flatnonzero(~taken)
    missing = limit - int(np.count_nonzero(taken))
    taken[others[(np.arange(missing) * len(others)) // max(missing, 1)]] = True
    return np.sort(order[taken])


def _z_order(p: F64) -> U64:
    """Return the place (N,) of points (N, 3) on a Z-order curve through their bounding cube."""
    low = p.min(axis=0)
    width = max(float((p - low).max()), 1e-12)
    cell = np.minimum((p - low) / width * (1 << _BITS), (1 << _BITS) - 1).astype(np.uint64)
    x, y, z = (_space(cell[:, axis]) for axis in range(3))
    return np.asarray(x | y << np.uint64(1) | z << np.uint64(2))


def _space(x: U64) -> U64:
    """Put two zero bits between the 16 bits of each number."""
    for shift, mask in (
        (16, 0x0000FF0000FF),
        (8, 0x00F00F00F00F),
        (4, 0x0C30C30C30C3),
        (2, 0x249249249249),
    ):
        x = (x | x << np.uint64(shift)) & np.uint64(mask)
    return x


PATH_ENDS = "path_ends"
"""Name of the layer with a part of two points, start and end, for each mission."""
_NEAR = 0.2
"""Ends that are closer than this part of the scene's radius share a label."""


@dataclasses.dataclass
class _Label:
    mission: str
    row: int
    p: F32  # (3,)
    lines: list[str]


def with_end_labels(scene: Scene, missions: set[str]) -> Scene:
    """Return a scene in which ends of paths that lie close together share one label.

    Args:
        scene: A scene whose ends have a label each.
        missions: Ids of the visible missions; the ends of the others have no label.
    """
    if PATH_ENDS not in scene.names:
        return scene
    layer = scene.layer(PATH_ENDS)
    points = {key: part for key, part in layer.parts.items() if isinstance(part, Points)}
    near_m = _NEAR * scene.extent.radius_m
    labels: list[_Label] = []
    for mission, part in points.items():
        if mission not in missions:
            continue
        for row, line in enumerate(part.labels):
            near = (label for label in labels if np.linalg.norm(label.p - part.p[row]) < near_m)
            label = next(near, None)
            if label is None:
                labels.append(_Label(mission, row, part.p[row], [line]))
            else:
                label.lines.append(line)
    texts = {(label.mission, label.row): "\n".join(label.lines) for label in labels}
    parts = dict(layer.parts)
    for mission, part in points.items():
        if part.labels:
            lines = tuple(texts.get((mission, row), "") for row in range(len(part.labels)))
            parts[mission] = dataclasses.replace(part, labels=lines if any(lines) else ())
    relabelled = dataclasses.replace(layer, parts=parts)
    layers = tuple(relabelled if other is layer else other for other in scene.layers)
    return dataclasses.replace(scene, layers=layers)
