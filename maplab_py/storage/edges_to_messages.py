"""Columns of the files of edges, and their conversion to messages, as C++ maplab writes them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from maplab_py.storage import maplab_map_pb2 as pb
from maplab_py.storage.file_contents import Columns, extend_finite, merge_unknown, starts, words
from maplab_py.vimap import TransformationKind, VIMap

_FIELDS = {
    TransformationKind.ODOMETRY: "odometry",
    TransformationKind.TRANSFORMATION: "transformation",
    TransformationKind.WHEEL_ODOMETRY: "wheel_odometry",
}
_TRANSFORMATIONS = ("kind", "T_A_B", "covariance", "sensor_id", "unknown")
_LOOP_CLOSURES = (
    "T_A_B",
    "covariance",
    "switch_variable",
    "switch_variable_variance",
    "unknown",
)
SAMPLES = ("sample.timestamp_ns", "sample.accel_gyro")
"""Columns that are parts of the map's own."""


def edge_counts(vi_map: VIMap) -> tuple[int, int, int]:
    """Return the number of inertial edges, of relative poses and of loop closures."""
    return len(vi_map.imu_edges), len(vi_map.transformation_edges), len(vi_map.loop_closure_edges)


def edge_columns(vi_map: VIMap, rows: range) -> Columns:
    """Return the columns of edges, which are counted in the order of `edge_counts`."""
    ends = np.cumsum(edge_counts(vi_map))
    imu, relative, loops = (
        slice(max(rows.start - first, 0), max(min(rows.stop, end) - first, 0))
        for first, end in zip((0, *ends[:-1].tolist()), ends.tolist(), strict=True)
    )
    start = vi_map.sample_start
    last = min(imu.stop, len(vi_map.imu_edges))
    samples = slice(int(start[min(imu.start, last)]), int(start[last]))
    return {
        **_ends(vi_map, "imu", vi_map.imu_edges, imu),
        "imu.unknown": vi_map.imu_edges.unknown[imu],
        "imu.sample_count": vi_map.imu_edges.sample_count[imu],
        "sample.timestamp_ns": vi_map.imu_samples.timestamp_ns[samples],
        "sample.accel_gyro": vi_map.imu_samples.accel_gyro[samples],
        **_ends(vi_map, "relative", vi_map.transformation_edges, relative),
        **_part("relative", vi_map.transformation_edges, _TRANSFORMATIONS, relative),
        **_ends(vi_map, "loop", vi_map.loop_closure_edges, loops),
        **_part("loop", vi_map.loop_closure_edges, _LOOP_CLOSURES, loops),
    }


def edges_to_bytes(columns: Columns) -> bytes:
    """Return the bytes of a file of edges."""
    message = pb.VIMap()
    _add_imu_edges(message, columns)
    _add_transformations(message, columns)
    _add_loop_closures(message, columns)
    return message.SerializeToString(deterministic=True)


def _ends(vi_map: VIMap, prefix: str, table: Any, rows: slice) -> dict[str, NDArray[Any]]:
    """Return the ids of edges, of their vertices and of their missions."""
    begin = table.from_vertex[rows]
    return {
        f"{prefix}.id": table.id[rows],
        f"{prefix}.from_id": vi_map.vertices.id[begin],
        f"{prefix}.to_id": vi_map.vertices.id[table.to_vertex[rows]],
        f"{prefix}.mission_id": vi_map.missions.id[vi_map.vertices.mission[begin]],
    }


def _part(prefix: str, table: Any, names: tuple[str, ...], rows: slice) -> dict[str, NDArray[Any]]:
    return {f"{prefix}.{name}": getattr(table, name)[rows] for name in names}


class _Ends:
    """Adds edges with the ids of their ends."""

    def __init__(self, message: pb.VIMap, columns: Columns, prefix: str) -> None:
        self._message = message
        names = ("id", "from_id", "to_id", "mission_id")
        lists = [words(columns[f"{prefix}.{name}"]) for name in names]
        self._rows = list(zip(*lists, strict=True))

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, row: int, field: str) -> Any:
        """Add an edge of a kind and return its message, ends filled."""
        edge_id, from_id, to_id, mission_id = self._rows[row]
        self._message.edge_ids.add().words.extend(edge_id)
        message = getattr(self._message.edges.add(), field)
        message.from_vertex_id.words.extend(from_id)
        message.to_vertex_id.words.extend(to_id)
        message.mission_id.words.extend(mission_id)
        return message


def _add_imu_edges(message: pb.VIMap, columns: Columns) -> None:
    ends = _Ends(message, columns, "imu")
    start = starts(columns["imu.sample_count"])
    for row in range(len(ends)):
        imu = ends.add(row, "imu")
        samples = slice(start[row], start[row + 1])
        imu.timestamps_ns.extend(columns["sample.timestamp_ns"][samples].tolist())
        imu.accel_gyro.extend(columns["sample.accel_gyro"][samples].reshape(-1).tolist())
        merge_unknown(imu, columns["imu.unknown"][row])


def _add_transformations(message: pb.VIMap, columns: Columns) -> None:
    ends = _Ends(message, columns, "relative")
    sensor_words = words(columns["relative.sensor_id"])
    for row in range(len(ends)):
        relative = ends.add(row, _FIELDS[TransformationKind(columns["relative.kind"][row])])
        relative.T_A_B.extend(columns["relative.T_A_B"][row].tolist())
        extend_finite(relative.covariance, columns["relative.covariance"][row])
        relative.sensor_id.words.extend(sensor_words[row])
        merge_unknown(relative, columns["relative.unknown"][row])


def _add_loop_closures(message: pb.VIMap, columns: Columns) -> None:
    ends = _Ends(message, columns, "loop")
    for row in range(len(ends)):
        loop = ends.add(row, "loop_closure")
        loop.T_A_B.extend(columns["loop.T_A_B"][row].tolist())
        extend_finite(loop.covariance, columns["loop.covariance"][row])
        loop.switch_variable = float(columns["loop.switch_variable"][row])
        loop.switch_variable_variance = float(columns["loop.switch_variable_variance"][row])
        merge_unknown(loop, columns["loop.unknown"][row])
