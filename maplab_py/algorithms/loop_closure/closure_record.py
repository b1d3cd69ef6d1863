"""Record of the loop closures of a map: every candidate with its verdict, and every merge.

The record is stored in one extension field per mission (closures belong to the mission of their
query), so that it is saved, loaded, merged and undone with the map. It refers to ids only: entries
of removed entities are skipped when the record is read. New ids for a map invalidate its record.
"""

from __future__ import annotations

import dataclasses
import json
import math
import weakref
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.loop_closure.closure_table import VERDICTS
from maplab_py.errors import MapError
from maplab_py.storage import extension_fields
from maplab_py.vimap import IdIndex, VIMap, to_hex_list
from maplab_py.vimap.table import Table, column, object_column

FIELD_NUMBER = extension_fields.LOOP_RECORD
"""Field number in the mission message."""
_MAX_HEADER_BYTES = 100_000
"""Maximum size of the header of a record; typical headers have about three thousand bytes."""

USES = ("", "merge", "edge", "relax", "anchor")
"""Use of a closure; codes of the `use` column are indices into this tuple."""


class ClosureRecord(Table):
    """Closures, accepted and refused, one row each. A is the query vertex, B the place's vertex."""

    id: NDArray[np.uint64] = column(np.uint64, 2)  # of an edge made from it, too
    query: NDArray[np.uint64] = column(np.uint64, 2)  # vertex id
    place: NDArray[np.uint64] = column(np.uint64, 2)  # vertex id
    T_A_B: NDArray[np.float64] = column(np.float64, 7)  # as verified
    sigma: NDArray[np.float32] = column(np.float32, 6)  # of it: position [m], angle [rad]
    use: NDArray[np.int8] = column(np.int8)  # index into USES
    weight: NDArray[np.float32] = column(np.float32, fill=1.0)  # weight after relaxation
    # the fields of closure_table.GateValues, as judged; older records lack those with a fill value
    verdict: NDArray[np.int8] = column(np.int8)
    matches: NDArray[np.int32] = column(np.int32)
    inliers: NDArray[np.int32] = column(np.int32)
    tilt_deg: NDArray[np.float32] = column(np.float32)
    rotation_sigma_deg: NDArray[np.float32] = column(np.float32, fill=np.nan)
    correction_m: NDArray[np.float32] = column(np.float32)
    correction_deg: NDArray[np.float32] = column(np.float32)
    is_related: NDArray[np.bool_] = column(np.bool_, fill=True)
    between_m: NDArray[np.float32] = column(np.float32, fill=np.nan)
    rival_share: NDArray[np.float32] = column(np.float32, fill=np.nan)
    rival_stretches: NDArray[np.float32] = column(np.float32, fill=np.nan)
    is_decided: NDArray[np.float32] = column(np.float32, fill=np.nan)
    follows: NDArray[np.float32] = column(np.float32, fill=np.nan)
    support: NDArray[np.int32] = column(np.int32)
    difference: NDArray[np.float32] = column(np.float32, fill=np.nan)


class MergedLandmarks(Table):
    """Landmarks removed by merges, with their state before."""

    id: NDArray[np.uint64] = column(np.uint64, 2)
    vertex: NDArray[np.uint64] = column(np.uint64, 2)  # id of the store vertex
    p_I: NDArray[np.float64] = column(np.float64, 3)
    quality: NDArray[np.int8] = column(np.int8)
    feature_type: NDArray[np.int32] = column(np.int32)


class MergedKeypoints(Table):
    """Keypoints whose landmark changed, with their original landmark."""

    frame: NDArray[np.uint64] = column(np.uint64, 2)  # id
    index: NDArray[np.int32] = column(np.int32)  # within the frame
    landmark: NDArray[np.uint64] = column(np.uint64, 2)  # id


class MergePairs(Table):
    """Closures (by id) that support the merge of two landmarks; one row per closure and pair."""

    first: NDArray[np.uint64] = column(np.uint64, 2)
    second: NDArray[np.uint64] = column(np.uint64, 2)
    closure: NDArray[np.uint64] = column(np.uint64, 2)
    wanted: NDArray[np.int32] = column(np.int32)  # closures that had to agree


@dataclasses.dataclass(frozen=True, eq=False)
class LoopRecord:
    """Record of all closures and merges of a map."""

    closures: ClosureRecord = dataclasses.field(default_factory=ClosureRecord.empty)
    landmarks: MergedLandmarks = dataclasses.field(default_factory=MergedLandmarks.empty)
    keypoints: MergedKeypoints = dataclasses.field(default_factory=MergedKeypoints.empty)
    pairs: MergePairs = dataclasses.field(default_factory=MergePairs.empty)

    @property
    def is_empty(self) -> bool:
        """Whether the record has no rows."""
        return not any(len(table) for table in self.tables().values())

    def tables(self) -> dict[str, Table]:
        """Return the tables by name."""
        return {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}

    @classmethod
    def concatenate(cls, parts: list[LoopRecord]) -> LoopRecord:
        """Join the records of several missions."""
        return cls(
            ClosureRecord.concatenate([part.closures for part in parts]),
            MergedLandmarks.concatenate([part.landmarks for part in parts]),
            MergedKeypoints.concatenate([part.keypoints for part in parts]),
            MergePairs.concatenate([part.pairs for part in parts]),
        )


def read_record(vi_map: VIMap) -> LoopRecord:
    """Return the record of the map without closures whose vertices were removed.

    Raises:
        MapError: The record is damaged.
    """
    contents = (
        extension_fields.read_extension(field, FIELD_NUMBER) for field in vi_map.missions.unknown
    )
    record = LoopRecord.concatenate([_decode(part) for part in contents if part is not None])
    closures = record.closures
    alive = (vi_map.vertex_index.rows(closures.query) >= 0) & (
        vi_map.vertex_index.rows(closures.place) >= 0
    )
    return dataclasses.replace(record, closures=closures.take(alive))


def write_record(vi_map: VIMap, record: LoopRecord) -> VIMap:
    """Return the map with its record replaced."""
    mission_of = np.append(vi_map.vertices.mission, 0)
    closures = mission_of[vi_map.vertex_index.rows(record.closures.query)]
    landmarks = mission_of[vi_map.vertex_index.rows(record.landmarks.vertex)]
    frame = IdIndex(vi_map.frames.id).rows(record.keypoints.frame)
    keypoints = mission_of[np.append(vi_map.frames.vertex, -1)[frame]]
    # pairs belong to the closure that supports them
    owner = IdIndex(record.closures.id).rows(record.pairs.closure)
    pairs = np.append(closures, 0)[owner]
    contents = []
    for row in range(len(vi_map.missions)):
        part = LoopRecord(
            record.closures.take(closures == row),
            record.landmarks.take(landmarks == row),
            record.keypoints.take(keypoints == row),
            record.pairs.take(pairs == row),
        )
        contents.append(None if part.is_empty else _encode(part))
    return _with_contents(vi_map, contents)


def drop_record(vi_map: VIMap) -> VIMap:
    """Return the map without a record, a damaged one included."""
    return _with_contents(vi_map, [None] * len(vi_map.missions))


def _with_contents(vi_map: VIMap, contents: list[bytes | None]) -> VIMap:
    fields = zip(vi_map.missions.unknown, contents, strict=True)
    unknown = [extension_fields.with_extension(old, FIELD_NUMBER, new) for old, new in fields]
    return vi_map.replace(missions=vi_map.missions.replace(unknown=object_column(unknown)))


def _encode(record: LoopRecord) -> bytes:
    layout: list[list[Any]] = []
    body: list[bytes] = []
    for name, table in record.tables().items():
        for column_name, array in table.columns().items():
            little = array.astype(array.dtype.newbyteorder("<"))
            layout.append([name, column_name, little.dtype.str, list(little.shape)])
            body.append(np.ascontiguousarray(little).tobytes())
    header = json.dumps(layout, separators=(",", ":")).encode()
    plain = len(header).to_bytes(4, "little") + header + b"".join(body)
    return extension_fields.PACKED + zlib.compress(plain, 6)


def _decode(content: bytes) -> LoopRecord:
    try:
        plain = extension_fields.unpacked(content)
        place = 4 + int.from_bytes(plain[:4], "little")
        if place > _MAX_HEADER_BYTES:
            raise ValueError(f"a header of {place} bytes")
        columns: dict[str, dict[str, NDArray[Any]]] = {}
        for table, name, dtype, shape in json.loads(plain[4:place]):
            count = math.prod(shape)
            if count < 0:
                raise ValueError(f"{table} {name} has the shape {shape}")
            array = np.frombuffer(plain, np.dtype(dtype), count, place).reshape(shape)
            columns.setdefault(table, {})[name] = array
            place += array.nbytes
        return LoopRecord(
            ClosureRecord.filled(len(columns["closures"]["id"]), **columns["closures"]),
            MergedLandmarks(**columns["landmarks"]),
            MergedKeypoints(**columns["keypoints"]),
            MergePairs(**columns["pairs"]),
        )
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise MapError(
            f"the record of loop closures is damaged ({error}); delete_loopclosure_record drops it"
        ) from None
    except MemoryError:
        raise MapError(
            "the record of loop closures does not fit into memory; "
            "delete_loopclosure_record drops it"
        ) from None


_DESCRIBED: weakref.WeakKeyDictionary[VIMap, list[tuple[str, str]]] = weakref.WeakKeyDictionary()
"""Descriptions of the closures of maps, which do not change as maps are values."""


def described_ids(vi_map: VIMap) -> list[tuple[str, str]]:
    """Return the beginnings of the ids of all recorded closures, with inliers and verdict."""
    if vi_map not in _DESCRIBED:
        c = read_record(vi_map).closures
        _DESCRIBED[vi_map] = [
            (id_[:8], f"{inliers} of {matches} matches, {VERDICTS[verdict].value}")
            for id_, inliers, matches, verdict in zip(
                to_hex_list(c.id),
                c.inliers.tolist(),
                c.matches.tolist(),
                c.verdict.tolist(),
                strict=True,
            )
        ]
    return _DESCRIBED[vi_map]
