"""References to compare the map with: another state, ground truth; and marked segments."""

import csv
import dataclasses
import io
from pathlib import Path

import numpy as np

from maplab_py.algorithms.evaluation.options import TrajectoryEvaluationOptions
from maplab_py.algorithms.evaluation.trajectory_evaluation import match
from maplab_py.array_types import F64, I64
from maplab_py.errors import EstimationError, MapError, UserError
from maplab_py.geometry import alignment, se3
from maplab_py.input_files import SCRIPT_MAX_BYTES, read_text
from maplab_py.interop.trajectories import Trajectory
from maplab_py.viewer import colours
from maplab_py.viewer.drawing import Drawing, make_points, make_segments
from maplab_py.viewer.layers.comparison import reference_landmarks, reference_paths
from maplab_py.viewer.scene import WHOLE_MAP, Layer, LegendEntry
from maplab_py.vimap import VIMap, find_mission


@dataclasses.dataclass(frozen=True, eq=False)
class MarkedSegments:
    """Pieces of missions with a number each, as the information that a calibration gets of them."""

    first_vertex: I64  # (N,) rows
    last_vertex: I64  # (N,)
    value: F64  # (N,)
    title: str = "information"


def compared(drawing: Drawing, other: VIMap) -> list[Layer]:
    """Another state of the map in grey, and how far the vertices have moved since.

    Args:
        other: The map to compare with; vertices correspond by id.
    """
    shift, grey = -drawing.origin_G, colours.REFERENCE
    return [
        reference_paths(other, shift, grey, 2.0),
        reference_landmarks(drawing, other, shift, grey, is_visible=False),
        _displacements(drawing, other),
    ]


def displacements(vi_map: VIMap, other: VIMap) -> tuple[I64, I64, F64]:
    """Return the rows (N,) of vertices that both maps have, and how far apart they are (N,) [m]."""
    there = other.vertex_index.rows(vi_map.vertices.id)
    here = np.flatnonzero(there >= 0)
    there = there[here]
    distance = np.linalg.norm(vi_map.T_G_I[here, 4:] - other.T_G_I[there, 4:], axis=1)
    return here, there, distance


def _displacements(drawing: Drawing, other: VIMap) -> Layer:
    here, there, distance = displacements(drawing.vi_map, other)
    before = other.T_G_I[there, 4:] - drawing.origin_G
    largest = max(float(distance.max(initial=0.0)), 1e-9)
    colour = colours.ramp(distance / largest, colours.HEAT)
    after = drawing.p_vertices[here]
    legend = LegendEntry.ramp("displacement", colours.HEAT, "0 m", f"{largest:.3g} m")
    parts = {WHOLE_MAP: make_segments(before, after, colour, here, 1.5)}
    return Layer("displacements", "Displacement", parts, len(here), legend=(legend,))


def _aligned_truth(stamps_ns: I64, p: F64, truth: Trajectory) -> tuple[I64, F64, F64]:
    """Return the vertices (N,) with ground truth, where they are in truth (N, 3), and T_scene_R.

    Raises:
        UserError: Too few vertices have ground truth to lay it on the map.
    """
    T_R_B, has_truth = match(truth, stamps_ns, TrajectoryEvaluationOptions())
    rows = np.flatnonzero(has_truth)
    if len(rows) < 3:
        raise UserError(
            f"{truth.source}: only {len(rows)} vertices have ground truth, 3 are needed "
            "(do the clocks agree?)"
        )
    try:
        T_scene_R = alignment.align_yaw_position(p[rows], T_R_B[rows, 4:])
    except EstimationError as error:
        raise UserError(f"{truth.source}: {error}") from None
    return rows, se3.transform(T_scene_R, T_R_B[rows, 4:]), T_scene_R


def position_errors(stamps_ns: I64, p: F64, truth: Trajectory) -> F64:
    """Return how far each vertex (V,) is from the true path laid on the map [m]; NaN without truth.

    Args:
        stamps_ns: Times (V,) of the vertices.
        p: Their positions (V, 3).

    Raises:
        UserError: Too few vertices have ground truth to lay it on the map.
    """
    rows, p_true, _ = _aligned_truth(stamps_ns, p, truth)
    error_m = np.full(len(p), np.nan)
    error_m[rows] = np.linalg.norm(p[rows] - p_true, axis=1)
    return error_m


def ground_truth(drawing: Drawing, truth: Trajectory) -> list[Layer]:
    """The true path laid on the map, and the error of each vertex.

    Raises:
        UserError: Too few vertices have ground truth to lay it on the map.
    """
    vi_map = drawing.vi_map
    stamps_ns = vi_map.vertices.timestamp_ns
    rows, p_true, T_scene_R = _aligned_truth(stamps_ns, drawing.p_vertices, truth)
    p_vertex = drawing.p_vertices[rows]
    span = vi_map.vertices.timestamp_ns[rows]
    inside = (truth.times_ns >= span.min()) & (truth.times_ns <= span.max())
    path = se3.transform(T_scene_R, truth.T_R_B[inside, 4:])
    path = path[:: max(1, len(path) // 20_000)]
    lines = make_segments(path[:-1], path[1:], colours.TRUTH, np.arange(len(path) - 1), 2.0)
    error_m = np.linalg.norm(p_vertex - p_true, axis=1)
    largest = max(float(error_m.max()), 1e-9)
    legend = (LegendEntry.ramp("position error", colours.HEAT, "0 m", f"{largest:.3g} m"),)
    colour = colours.ramp(error_m / largest, colours.HEAT)
    errors = {WHOLE_MAP: make_segments(p_true, p_vertex, colour, rows, 1.5)}
    dots = {WHOLE_MAP: make_points(p_vertex, colour, rows, 0.008 * drawing.unit_m)}
    return [
        Layer("ground_truth", "Ground truth", {WHOLE_MAP: lines}, len(truth)),
        Layer("errors", "Position errors", errors, len(rows), legend=legend),
        Layer("error_colours", "Vertices by error", dots, len(rows), is_visible=False),
    ]


def marked_segments(drawing: Drawing, segments: MarkedSegments) -> Layer:
    """Pieces of the trajectories, coloured by their number (Schneider 2019, figures 7.1 and 7.10)."""
    part, low, high = colours.normalised(segments.value)
    colour = colours.ramp(part, colours.HEAT)
    lengths = np.maximum(segments.last_vertex - segments.first_vertex, 0)
    owner = np.repeat(np.arange(len(lengths)), lengths)
    begin = np.repeat(np.cumsum(lengths) - lengths, lengths)
    start = segments.first_vertex[owner] + np.arange(len(owner)) - begin
    p = drawing.p_vertices
    mission = drawing.vi_map.vertices.mission
    ends = p[start], p[start + 1]
    parts = drawing.segments(mission[start], *ends, colour[owner], owner, 7.0)
    legend = LegendEntry.ramp(segments.title, colours.HEAT, f"{low:.3g}", f"{high:.3g}")
    return Layer("marked_segments", "Informative segments", parts, len(lengths), legend=(legend,))


COLUMNS = ("mission", "start_ns", "end_ns", "information")


def read_segments(path: Path, vi_map: VIMap) -> MarkedSegments:
    """Read a CSV file with a header that names the columns mission, start_ns, end_ns, information.

    Missions are ids or their unambiguous beginnings; times are those of vertices, in nanoseconds.

    Raises:
        MapError: The file cannot be read, or a line is not as described; names the line.
        UserError: The map has no such mission.
    """
    try:
        text = read_text(path, SCRIPT_MAX_BYTES, remedy="tables of segments are shorter")
        rows = list(csv.DictReader(io.StringIO(text), skipinitialspace=True))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise MapError(f"{path}: cannot be read ({error})") from None
    if not rows or not set(COLUMNS) <= set(rows[0]):
        raise MapError(
            f"{path}: a header with {', '.join(COLUMNS)} and lines below it are expected"
        )
    first, last, value = [], [], []
    for number, row in enumerate(rows, start=2):
        try:
            begin_ns, end_ns = int(row["start_ns"]), int(row["end_ns"])
            value.append(float(row["information"]))
        except (TypeError, ValueError):
            raise MapError(
                f"{path}:{number}: whole nanoseconds and a number are expected"
            ) from None
        mission = find_mission(vi_map, row["mission"])
        start, stop = vi_map.vertex_start[mission : mission + 2].tolist()
        times = vi_map.vertices.timestamp_ns[start:stop]
        inside = np.flatnonzero((times >= begin_ns) & (times <= end_ns))
        if not len(inside):
            raise MapError(f"{path}:{number}: the mission has no vertex between these times")
        first.append(start + int(inside[0]))
        last.append(start + int(inside[-1]))
    return MarkedSegments(np.array(first), np.array(last), np.array(value))
