"""Reader of external loop closures in maplab's YAML format: times, poses, relative poses.

A list of entries with `camera_from` and `camera_to` (each `timestamp_ns` and `pose`: where that
program estimated the device in G), `T_from_to`, `switch_variable`, `switch_variable_variance`
and `covariance` (36 numbers, position before orientation). Poses are `rotation_xyzw` and
`translation_m`.
"""

from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.array_types import F64, I64, NDArray
from maplab_py.errors import MapError
from maplab_py.geometry import interpolation, se3, so3
from maplab_py.input_files import DEFAULT_MAX_BYTES, LARGEST, read_foreign_text
from maplab_py.report import counted
from maplab_py.sensors.yaml_text import parse_yaml
from maplab_py.vimap import LoopClosureEdges, VIMap, edits, random_ids

_MAX_TIME_NS = 20_000_000
"""Maximum time between an entry and a vertex, as in maplab; other entries are skipped."""


def read_external_closures(vi_map: VIMap, path: Path) -> tuple[LoopClosureEdges, list[str]]:
    """Read loop closures and transform them to the nearest vertices.

    From the device's pose S at the entry's time to the vertex pose S2 nearby, and T to T2 at the
    other end: T_S2_T2 = T_S2_S T_S_T T_T_T2, where T_S2_S follows from the map and the entry's pose.

    Returns:
        The edges, and a note on entries without a vertex within 20 ms.

    Raises:
        MapError: The file cannot be read or an entry is wrong; names file and entry.
    """
    entries = _entries(path)
    count = len(entries)
    time_ns = np.zeros((count, 2), dtype=np.int64)
    T_G_S, T_S_T = np.zeros((count, 2, 7)), np.zeros((count, 7))
    covariance, switch = np.zeros((count, 6, 6)), np.zeros((count, 2))
    for i, entry in enumerate(entries):
        try:
            for end, name in enumerate(("camera_from", "camera_to")):
                time_ns[i, end] = int(entry[name]["timestamp_ns"])
                T_G_S[i, end] = _pose(entry[name]["pose"])
            T_S_T[i] = _pose(entry["T_from_to"])
            numbers = np.array(entry["covariance"], dtype=np.float64)
            covariance[i] = numbers.reshape(6, 6)
            switch[i] = float(entry["switch_variable"]), float(entry["switch_variable_variance"])
            if not all(np.isfinite(v[i]).all() for v in (T_G_S, T_S_T, covariance, switch)):
                raise ValueError("a number is not finite")
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            what = f"'{error.args[0]}' is missing" if isinstance(error, KeyError) else str(error)
            raise MapError(f"{path}: entry {i + 1}: {what}") from None
    vertex, near = _nearest(vi_map, time_ns)
    rows = np.flatnonzero(near.all(axis=1))
    T_G_V = vi_map.T_G_I[vertex[rows]]
    T_V_S = se3.relative(T_G_V, T_G_S[rows])
    T_A_B = se3.compose(se3.compose(T_V_S[:, 0], T_S_T[rows]), se3.inverse(T_V_S[:, 1]))
    edges = LoopClosureEdges.filled(
        len(rows),
        id=random_ids(len(rows), edits.content_rng(vi_map, "external loop closures")),
        from_vertex=vertex[rows, 0],
        to_vertex=vertex[rows, 1],
        T_A_B=T_A_B,
        covariance=covariance[rows],
        switch_variable=switch[rows, 0],
        switch_variable_variance=switch[rows, 1],
    )
    left_out = count - len(rows)
    of = counted(count, "entry", "entries")
    notes = [f"{left_out} of {of} without a vertex within 20 ms"] if left_out else []
    return edges, notes


def _entries(path: Path) -> list[Any]:
    content = parse_yaml(read_foreign_text(path, DEFAULT_MAX_BYTES), str(path))
    if not isinstance(content, list):
        raise MapError(f"{path}: a list of loop closures is expected")
    return content


def _pose(node: Any) -> F64:
    q = np.array(node["rotation_xyzw"], dtype=np.float64)
    p = np.array(node["translation_m"], dtype=np.float64)
    if q.shape != (4,) or p.shape != (3,) or not 0.0 < np.abs(q).max() <= LARGEST:
        raise ValueError("a pose needs rotation_xyzw (4 numbers) and translation_m (3)")
    return se3.make(so3.normalize(q), p)


def _nearest(vi_map: VIMap, time_ns: I64) -> tuple[I64, NDArray[np.bool_]]:
    """Return the vertex rows (N, 2) nearest in time and a mask of those within the limit."""
    order = np.argsort(vi_map.vertices.timestamp_ns, kind="stable")
    times = vi_map.vertices.timestamp_ns[order]
    if len(times) == 0:
        return np.zeros(time_ns.shape, dtype=np.int64), np.zeros(time_ns.shape, dtype=np.bool_)
    closer = interpolation.nearest_rows(times, time_ns)
    return order[closer], np.abs(times[closer] - time_ns) <= _MAX_TIME_NS
