"""Pieces of missions with their information, as a calibration on selected segments writes them."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np

from maplab_py.errors import MapError
from maplab_py.input_files import SCRIPT_MAX_BYTES, read_text
from maplab_py.viewer.layers.references import MarkedSegments
from maplab_py.vimap import VIMap
from maplab_py.vimap.queries import find_mission

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
