"""A map in the order in which it was recorded: what is there after each step."""

import dataclasses

import numpy as np

from maplab_py.algorithms.landmarks.sightings import residuals
from maplab_py.array_types import F64, I64
from maplab_py.distinct import distinct
from maplab_py.errors import MapError
from maplab_py.interop.trajectories import Trajectory
from maplab_py.viewer.drawing import PATH_ENDS, Drawing, first_observer, spread_rows
from maplab_py.viewer.layers.references import position_errors
from maplab_py.viewer.options import PlaybackOptions
from maplab_py.viewer.scene import Layer, Part, Points, Scene, Segments
from maplab_py.vimap import LandmarkQuality, VIMap

_RECENT_STEPS = 8

_PLAYED_LAYERS = {"trajectories", "vertices", "landmarks", "bad_landmarks", "observers"}


@dataclasses.dataclass(frozen=True, eq=False)
class Timeline:
    """Steps that bring vertices and landmarks. Step 0 shows the first vertices only."""

    steps: int
    vertex_step: I64  # (V,)
    landmark_step: I64  # (L,); `steps` where nothing observes it
    landmarks: I64  # rows that are drawn
    head: I64  # (steps + 1, M) vertex row that each mission has reached, -1 = not started
    seconds: F64  # (steps + 1,) time since the start of the longest mission

    def recent(self, drawing: Drawing, step: int) -> tuple[I64, F64]:
        """Return the landmarks (N,) that the last few steps observe, and their age (N,) in [0, 1)."""
        vi_map = drawing.vi_map
        observer = vi_map.keypoint_vertex[vi_map.observations]
        age = step - self.vertex_step[observer]
        is_recent = (age >= 0) & (age < _RECENT_STEPS)
        landmark = vi_map.keypoints.landmark[vi_map.observations[is_recent]]
        order = np.lexsort((age[is_recent], landmark))
        rows, first = np.unique(landmark[order], return_index=True)
        return rows.astype(np.int64), age[is_recent][order][first] / _RECENT_STEPS


def make_timeline(drawing: Drawing, options: PlaybackOptions) -> Timeline:
    """Spread the missions over the steps."""
    vi_map, steps = drawing.vi_map, options.steps
    progress, seconds = _progress(drawing, options)
    vertex_step = np.minimum(np.ceil(progress * steps - 1e-9).astype(np.int64), steps)
    first = first_observer(vi_map)
    landmark_step = np.full(len(first), steps, dtype=np.int64)
    landmark_step[first >= 0] = vertex_step[first[first >= 0]]
    good = np.flatnonzero(
        (vi_map.landmarks.quality != 1) & np.isfinite(drawing.p_landmarks).all(axis=1)
    )
    good = good[spread_rows(drawing.p_landmarks[good], drawing.options.max_points)]
    head = np.full((steps + 1, len(vi_map.missions)), -1, dtype=np.int64)
    for mission in range(len(vi_map.missions)):
        start, stop = vi_map.vertex_start[mission : mission + 2].tolist()
        reached = np.searchsorted(vertex_step[start:stop], np.arange(steps + 1), side="right")
        head[:, mission] = np.where(reached > 0, start + reached - 1, -1)
    return Timeline(steps, vertex_step, landmark_step, good, head, seconds)


def step_seconds(drawing: Drawing, options: PlaybackOptions) -> F64:
    """Return the time (steps + 1,) of each step since the start of the longest mission [s]."""
    return _progress(drawing, options)[1]


def _progress(drawing: Drawing, options: PlaybackOptions) -> tuple[F64, F64]:
    """Return how far along (V,) each vertex is in [0, 1], and the time of each step."""
    vi_map = drawing.vi_map
    time_s = 1e-9 * vi_map.vertices.timestamp_ns
    value = np.zeros(len(time_s))
    longest, duration = 0.0, -1.0
    timed = slice(0, 0)  # vertices of the mission that lasts longest
    for mission in range(len(vi_map.missions)):
        mission_vertices = slice(*vi_map.vertex_start[mission : mission + 2].tolist())
        if mission_vertices.start == mission_vertices.stop:
            continue
        travelled = time_s[mission_vertices] - time_s[mission_vertices][0]
        if travelled[-1] > duration:
            duration, timed = float(travelled[-1]), mission_vertices
        if options.synchronize_missions_on_distance:
            step = np.linalg.norm(
                np.diff(vi_map.vertices.T_M_I[mission_vertices, 4:], axis=0), axis=1
            )
            travelled = np.append(0.0, np.cumsum(step))
        if options.synchronize_missions_on_distance_percent:
            travelled = travelled / max(float(travelled[-1]), 1e-12)
        value[mission_vertices] = travelled
        longest = max(longest, float(travelled[-1]))
    progress = value / max(longest, 1e-12)
    share = np.linspace(0.0, 1.0, options.steps + 1)
    since = time_s[timed] - time_s[timed][:1]
    seconds = np.interp(share, progress[timed], since) if len(since) else share
    return progress, seconds


def without_played(scene: Scene) -> Scene:
    """Return the scene without the layers that playback draws itself."""
    kept = tuple(
        layer
        for layer in scene.layers
        if layer.name not in _PLAYED_LAYERS and not layer.name.startswith("cloud_")
    )
    return dataclasses.replace(scene, layers=kept)


_VERTEX_LAYERS = ("vertices", PATH_ENDS)
_PATH_LAYERS = ("trajectories",)
_LANDMARK_LAYERS = ("landmarks", "bad_landmarks")


def moved_scene(scene: Scene, drawing: Drawing, vi_map: VIMap) -> Scene:
    """Return the scene with trajectories, vertices and landmarks where a map has them now.

    Args:
        drawing: What it was drawn of.
        vi_map: A map with the same rows whose positions differ.
    """
    if len(vi_map.vertices) != len(drawing.vi_map.vertices) or len(vi_map.landmarks) != len(
        drawing.vi_map.landmarks
    ):
        return scene
    moved = dataclasses.replace(drawing, vi_map=vi_map)
    return dataclasses.replace(scene, layers=tuple(_moved(layer, moved) for layer in scene.layers))


def _moved(layer: Layer, drawing: Drawing) -> Layer:
    if layer.name in _VERTEX_LAYERS:
        parts = {key: _at(part, drawing.p_vertices) for key, part in layer.parts.items()}
    elif layer.name in _LANDMARK_LAYERS:
        parts = {key: _at(part, drawing.p_landmarks) for key, part in layer.parts.items()}
    elif layer.name in _PATH_LAYERS:
        parts = {key: _along(part, drawing.p_vertices) for key, part in layer.parts.items()}
    else:
        return layer
    return dataclasses.replace(layer, parts=parts)


def _at(part: Part, p: F64) -> Part:
    if not isinstance(part, Points):
        return part
    return dataclasses.replace(part, p=p[part.rows].astype(np.float32))


def _along(part: Part, p: F64) -> Part:
    if not isinstance(part, Segments):
        return part
    ends = np.stack([p[part.rows], p[part.rows + 1]], axis=1)
    return dataclasses.replace(part, ends=ends.astype(np.float32))


@dataclasses.dataclass(frozen=True, eq=False)
class Signal:
    """One plot."""

    title: str
    unit: str
    values: F64  # (V, K), one row per vertex; NaN = not known there
    decimals: int


def vertex_signals(drawing: Drawing, truth: Trajectory | None = None) -> tuple[Signal, ...]:
    """Return what is known of all vertices of a map; what no vertex has is left out.

    Args:
        truth: True trajectory to compare the positions with.
    """
    vi_map = drawing.vi_map
    vertices = vi_map.vertices
    error_px, landmarks = observation_signals(vi_map)
    signals = [
        Signal("velocity", "m/s", vertices.v_M, 2),
        Signal("accelerometer bias", "m/s²", vertices.accel_bias, 3),
        Signal("gyroscope bias", "rad/s", vertices.gyro_bias, 4),
        Signal("reprojection error", "px", error_px[:, None], 2),
        Signal("landmarks", "", landmarks[:, None], 0),
    ]
    if truth is not None:
        error_m = position_errors(drawing.vi_map.vertices.timestamp_ns, drawing.p_vertices, truth)
        signals.append(Signal("position error", "m", error_m[:, None], 3))
    return tuple(s for s in signals if np.any(np.isfinite(s.values) & (s.values != 0.0)))


def observation_signals(vi_map: VIMap) -> tuple[F64, F64]:
    """Return the mean reprojection error (V,) [px] and the number of observed landmarks (V,).

    Landmarks of bad quality, and those behind the camera, do not count in the error; it is NaN for
    vertices without observations and in maps without calibrated cameras.
    """
    count = len(vi_map.vertices)
    keypoints = vi_map.observations
    vertex = vi_map.keypoint_vertex[keypoints].astype(np.int64)
    landmark = vi_map.keypoints.landmark[keypoints].astype(np.int64)
    pairs = distinct(vertex * max(len(vi_map.landmarks), 1) + landmark)
    observed = np.bincount(pairs // max(len(vi_map.landmarks), 1), minlength=count)
    usable = vi_map.landmarks.quality[landmark] != LandmarkQuality.BAD
    keypoints, vertex, landmark = keypoints[usable], vertex[usable], landmark[usable]
    mean_px = np.full(count, np.nan)
    try:
        error_px = residuals(vi_map, keypoints, vi_map.p_G[landmark]).error_px
    except MapError:
        return mean_px, observed.astype(np.float64)
    seen = np.isfinite(error_px)
    number = np.bincount(vertex[seen], minlength=count)
    total = np.bincount(vertex[seen], error_px[seen], minlength=count)
    np.divide(total, number, out=mean_px, where=number > 0)
    return mean_px, observed.astype(np.float64)
