"""Landmarks: which are drawn, and in which colour."""

import numpy as np
from numpy.typing import NDArray

from maplab_py.array_types import F64, I64, U8
from maplab_py.viewer import colours
from maplab_py.viewer.drawing import (
    MAX_POINTS,
    NO_POSITION,
    Drawing,
    MapImages,
    first_camera,
    first_observer,
    omission_notes,
    spread_rows,
)
from maplab_py.viewer.scene import Entity, Layer, LegendEntry
from maplab_py.vimap import LandmarkQuality, VIMap
from maplab_py.vimap.descriptors import type_of_name
from maplab_py.vimap.queries import observation_counts, observer_counts


def landmarks(drawing: Drawing) -> list[Layer]:
    """The landmarks, and those of bad quality as a separate layer."""
    steps = _selection_steps(drawing)
    chosen = np.flatnonzero(np.all([keep for keep, _ in steps], axis=0))
    is_bad = drawing.vi_map.landmarks.quality == LandmarkQuality.BAD
    limit = drawing.options.max_points
    every, legend = landmark_colours(drawing)
    layers = []
    for name, title, members_of in (
        ("landmarks", "Landmarks", ~is_bad),
        ("bad_landmarks", "Bad landmarks", is_bad),
    ):
        rows = chosen[members_of[chosen]]
        if not len(rows) and name != "landmarks":
            continue
        shown = rows[spread_rows(drawing.p_landmarks[rows], limit)]
        p, mission = drawing.p_landmarks[shown], drawing.landmark_mission[shown]
        parts = drawing.points(mission, p, every[shown], shown, point_size(drawing))
        is_visible = name == "landmarks" or not drawing.options.check_landmark_constrained
        thinned = (len(rows) - len(shown), MAX_POINTS)
        notes = omission_notes(title, len(shown), *_losses(steps, members_of), thinned)
        if name == "landmarks":
            notes += chosen_missions(drawing)[1]
        layers.append(
            Layer(name, title, parts, len(rows), Entity.LANDMARK, is_visible, legend, notes)
        )
    return layers


def point_size(drawing: Drawing) -> float:
    """Return the diameter of landmarks [m]."""
    return 0.0024 * drawing.unit_m


def _selection_steps(drawing: Drawing) -> list[tuple[NDArray[np.bool_], str]]:
    """Return for each condition on landmarks which of them (L,) meet it, and its words."""
    options, vi_map = drawing.options, drawing.vi_map
    is_finite = np.asarray(np.isfinite(drawing.p_landmarks).all(axis=1))
    steps: list[tuple[NDArray[np.bool_], str]] = [(is_finite, NO_POSITION)]
    if options.landmarks_min_observers > 0:
        keep = observer_counts(vi_map) >= options.landmarks_min_observers
        steps.append((keep, "by --vis_landmarks_min_observers"))
    if options.landmarks_min_number_of_observer_missions > 0:
        wanted = options.landmarks_min_number_of_observer_missions
        keep = observer_mission_counts(vi_map) >= wanted
        steps.append((keep, "by --vis_landmarks_min_number_of_observer_missions"))
    if options.show_only_landmark_type:
        keep = vi_map.landmarks.feature_type == type_of_name(options.show_only_landmark_type)
        steps.append((keep, "by --vis_show_only_landmark_type"))
    return steps


def _losses(
    steps: list[tuple[NDArray[np.bool_], str]], members: NDArray[np.bool_]
) -> list[tuple[int, str]]:
    """Return how many members (L,) each condition leaves out of those that the earlier ones keep."""
    losses, kept = [], members
    for keep, words in steps:
        losses.append((int(np.count_nonzero(kept & ~keep)), words))
        kept = kept & keep
    return losses


def observer_mission_counts(vi_map: VIMap) -> I64:
    """Return the number (L,) of missions that observe each landmark."""
    keypoints = vi_map.observations
    missions = max(len(vi_map.missions), 1)
    landmark = vi_map.keypoints.landmark[keypoints].astype(np.int64)
    pairs = np.unique(
        landmark * missions + vi_map.vertices.mission[vi_map.keypoint_vertex[keypoints]]
    )
    return np.bincount(pairs // missions, minlength=len(vi_map.landmarks))


def first_observation_s(vi_map: VIMap) -> F64:
    """Return when each landmark (L,) was first observed: seconds since its mission's start, or NaN."""
    vertex = first_observer(vi_map)
    seen = vertex >= 0
    begin = vi_map.vertices.timestamp_ns[vi_map.vertex_start[:-1].clip(0, len(vi_map.vertices) - 1)]
    seconds = np.full(len(vertex), np.nan)
    observers = vertex[seen]
    since = vi_map.vertices.timestamp_ns[observers] - begin[vi_map.vertices.mission[observers]]
    seconds[seen] = 1e-9 * since
    return seconds


def landmark_colours(drawing: Drawing) -> tuple[U8, tuple[LegendEntry, ...]]:
    """Return a colour (L, 3) for each landmark by the rule of the options, and the legend."""
    every, legend = _rule_colours(drawing)
    if drawing.options.color_only_missions:
        chosen, _ = chosen_missions(drawing)
        is_other = ~chosen[drawing.landmark_mission]
        every = np.where(is_other[:, None], _colours_by_mission(drawing), every)
    return every, legend


def chosen_missions(drawing: Drawing) -> tuple[NDArray[np.bool_], tuple[str, ...]]:
    """Return which missions (M,) the rule of colours is for, and a line for each unknown id."""
    chosen = np.zeros(len(drawing.mission_ids), dtype=np.bool_)
    problems = []
    for prefix in drawing.options.color_only_missions.replace(",", " ").lower().split():
        matches = [mission_id.startswith(prefix) for mission_id in drawing.mission_ids]
        chosen |= np.array(matches, dtype=np.bool_)
        if not any(matches):
            problems.append(f"--vis_color_only_missions: no mission has the id {prefix}")
    return chosen, tuple(problems)


def _colours_by_mission(drawing: Drawing) -> U8:
    pale = colours.mixed(drawing.mission_colours, colours.REFERENCE, 0.45)
    return pale[drawing.landmark_mission]


def _rule_colours(drawing: Drawing) -> tuple[U8, tuple[LegendEntry, ...]]:
    """Colour all landmarks by the rule."""
    rule = drawing.options.landmark_colouring
    if rule == "mission":
        return _colours_by_mission(drawing), ()
    if rule == "quality":
        entries = ("not judged", "bad", "good")
        legend = zip(entries, colours.hex_codes(colours.QUALITY), strict=True)
        quality = drawing.vi_map.landmarks.quality
        return colours.QUALITY[quality], tuple(LegendEntry(t, (c,)) for t, c in legend)
    if rule == "type":
        kinds, place = np.unique(drawing.vi_map.landmarks.feature_type, return_inverse=True)
        palette = colours.mission_colours(max(len(kinds), 1))
        names = zip(kinds.tolist(), colours.hex_codes(palette), strict=False)
        return palette[place], tuple(LegendEntry(f"type {kind}", (c,)) for kind, c in names)
    if rule == "camera":
        return _camera_colours(drawing.vi_map)
    if rule == "pixels":
        return _pixel_colours(drawing)
    if rule == "grey":
        grey = np.full(3, drawing.options.landmark_gray_level, dtype=np.uint8)
        return np.tile(grey, (len(drawing.vi_map.landmarks), 1)), ()
    if rule in ("observations", "missions"):
        return _count_colours(drawing, rule)
    return _scale_colours(drawing, rule)


def _camera_colours(vi_map: VIMap) -> tuple[U8, tuple[LegendEntry, ...]]:
    """Colour by the index of the camera whose frame observed a landmark first."""
    camera = first_camera(vi_map)
    seen = camera >= 0
    palette = colours.mission_colours(int(camera.max(initial=0)) + 1)
    every = np.tile(colours.REFERENCE, (len(camera), 1))
    every[seen] = palette[camera[seen]]
    codes = colours.hex_codes(palette)
    legend = [LegendEntry(f"camera {k}", (codes[k],)) for k in np.unique(camera[seen]).tolist()]
    if not seen.all():
        legend.append(LegendEntry("not observed", (colours.to_hex(colours.REFERENCE),)))
    return every, tuple(legend)


_VISIBLE = 40, 215
"""Range of pixels that can be seen on a light and on a dark ground."""


def _pixel_colours(drawing: Drawing) -> tuple[U8, tuple[LegendEntry, ...]]:
    """Colour by the pixels of the images that the map keeps; the others stay in the neutral grey."""
    code = colours.to_hex(colours.REFERENCE)
    every = np.tile(colours.REFERENCE, (len(drawing.vi_map.landmarks), 1))
    if not isinstance(drawing.images, MapImages):
        return every, (LegendEntry("the map keeps no images", (code,)),)
    colour, is_known = drawing.images.pixels()
    every[is_known] = np.clip(colour[is_known], *_VISIBLE)
    return every, (LegendEntry("pixels (this grey: unknown)", (code,)),)


def _scale_colours(drawing: Drawing, rule: str) -> tuple[U8, tuple[LegendEntry, ...]]:
    """Colour by height or by time."""
    options, vi_map = drawing.options, drawing.vi_map
    if rule == "height":
        height = vi_map.p_G[:, 2]
        if options.color_only_missions:
            height = np.where(chosen_missions(drawing)[0][drawing.landmark_mission], height, np.nan)
        part, low, high = colours.normalised(
            height, options.color_by_height_period_m, options.color_by_height_offset_m
        )
        title, unit = "height", "m"
    else:
        seconds = first_observation_s(vi_map)
        part, low, high = colours.normalised(
            seconds, options.color_landmarks_by_time_period_seconds
        )
        title, unit = "first observed after", "s"
    ends = f"{low:.1f} {unit}", f"{high:.1f} {unit}"
    legend = LegendEntry.ramp(title, colours.SEQUENTIAL, *ends)
    return colours.ramp(part, colours.SEQUENTIAL), (legend,)


def _count_colours(drawing: Drawing, rule: str) -> tuple[U8, tuple[LegendEntry, ...]]:
    """Colour by the number of observations or of observing missions, from 1 to the limit."""
    vi_map = drawing.vi_map
    counts = (
        observation_counts(vi_map) if rule == "observations" else observer_mission_counts(vi_map)
    )
    limit = max(drawing.options.landmarks_max_observers, 2)
    title = "observations" if rule == "observations" else "observing missions"
    legend = LegendEntry.ramp(title, colours.SEQUENTIAL, "1", f"{limit}+")
    return colours.ramp((counts - 1.0) / (limit - 1.0), colours.SEQUENTIAL), (legend,)
