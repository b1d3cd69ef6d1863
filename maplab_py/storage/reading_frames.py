"""Frames, keypoints, landmarks and their observations, read from vertices."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maplab_py.errors import MapError
from maplab_py.storage import numbers
from maplab_py.storage.words import ids_of, unknown_bytes
from maplab_py.vimap.ids import IdIndex, is_valid, to_hex
from maplab_py.vimap.table import starts_of_counts
from maplab_py.vimap.tables import FrameField, Frames, Keypoints, Landmarks

U64 = NDArray[np.uint64]
I64 = NDArray[np.int64]

_OPTIONAL = {
    FrameField.SIGMA: ("sigmas_px", 1),
    FrameField.SCALE: ("scales", 1),
    FrameField.TRACK_ID: ("track_ids", 1),
    FrameField.POSITION_3D: ("positions_3d", 3),
    FrameField.TIME_OFFSET: ("time_offsets_ns", 1),
    FrameField.LANDMARK_ID: ("landmark_ids", 1),
}


@dataclasses.dataclass(frozen=True, eq=False)
class FrameContent:
    """Frames with keypoints; landmarks of keypoints still as ids."""

    frames: Frames
    keypoints: Keypoints
    landmark_ids: U64  # (K, 2), zero = none


def read_frames(vertices: list[Any]) -> FrameContent:
    """Return the frames of all vertices (in row order) and their keypoints.

    Raises:
        MapError: Sizes within a frame do not fit each other.
    """
    owned = [
        (row, camera, frame)
        for row, vertex in enumerate(vertices)
        for camera, frame in enumerate(vertex.nframe.frames)
    ]
    frames = [frame for _, _, frame in owned]
    counts = [_checked_count(frame) for frame in frames]
    present = [_present(frame) for frame in frames]
    table = Frames.filled(
        len(frames),
        id=ids_of([f.id for f in frames], "id of a frame"),
        vertex=[row for row, _, _ in owned],
        camera_index=[camera for _, camera, _ in owned],
        timestamp_ns=[f.timestamp_ns for f in frames],
        is_valid=[f.is_valid if f.HasField("is_valid") else True for f in frames],
        keypoint_count=counts,
        descriptor_size=[
            len(f.descriptors) // n if n else 0 for f, n in zip(frames, counts, strict=True)
        ],
        present=present,
        descriptor_types=_objects([tuple(f.descriptor_types) or None for f in frames]),
        unknown=_objects([unknown_bytes(f) for f in frames]),
    )
    return _with_keypoints(table, frames)


def read_landmarks(vertices: list[Any]) -> tuple[Landmarks, U64, I64, I64, I64]:
    """Return landmarks by vertex row, and their own lists of observations.

    Returns:
        The landmarks, and for each listed observation: vertex id (O, 2), frame index (O,),
        keypoint index (O,), landmark row (O,).

    Raises:
        MapError: The three lists of a landmark differ in length, or a number is not one.
    """
    owned = [
        (row, lm) for row, vertex in enumerate(vertices) for lm in vertex.landmark_store.landmarks
    ]
    landmarks = [lm for _, lm in owned]
    counts = [len(lm.observer_vertex_ids) for lm in landmarks]
    for lm, count in zip(landmarks, counts, strict=True):
        if not count == len(lm.keypoint_indices) == len(lm.frame_indices):
            name = to_hex(ids_of([lm.id], "id of a landmark")[0])
            raise MapError(f"landmark {name}: its three lists of observations differ in length")
    table = Landmarks.filled(
        len(landmarks),
        id=ids_of([lm.id for lm in landmarks], "id of a landmark"),
        vertex=[row for row, _ in owned],
        p_I=numbers.finite(
            numbers.rows_or([lm.p_I for lm in landmarks], 3, 0.0, "the position of a landmark"),
            "the position of a landmark",
        ),
        covariance=numbers.covariances(
            [lm.covariance for lm in landmarks], 3, "the covariance of a landmark"
        ),
        quality=[lm.quality for lm in landmarks],
        feature_type=[lm.feature_type for lm in landmarks],
        unknown=_objects([unknown_bytes(lm) for lm in landmarks]),
    )
    observers = ids_of(
        (i for lm in landmarks for i in lm.observer_vertex_ids), "observer of a landmark"
    )
    frame_index = _joined([lm.frame_indices for lm in landmarks])
    keypoint_index = _joined([lm.keypoint_indices for lm in landmarks])
    return table, observers, frame_index, keypoint_index, np.repeat(np.arange(len(counts)), counts)


def linked_keypoints(
    content: FrameContent, landmark_index: IdIndex, listed: tuple[I64, I64], *, repair: bool
) -> tuple[NDArray[np.int32], list[str]]:
    """Decide which landmark each keypoint observes, from both places that say so.

    Args:
        content: Frames with the ids that they name.
        landmark_index: Rows of landmarks.
        listed: Keypoint and landmark rows (O,) of the landmarks' own lists; -1 = no such keypoint.
        repair: Keep links that both say and drop the rest, instead of refusing.

    Returns:
        Landmark rows (K,), -1 = none, and notes about repairs.

    Raises:
        MapError: The two disagree and repair is off.
    """
    named = landmark_index.rows(content.landmark_ids)
    dangling = is_valid(content.landmark_ids) & (named < 0)
    by_list = np.full(len(named), -1, dtype=np.int64)
    keypoint, landmark = listed
    exists = keypoint >= 0
    by_list[keypoint[exists]] = landmark[exists]
    disagree = (named != by_list) | dangling
    count = int(np.count_nonzero(disagree)) + int(np.count_nonzero(~exists))
    doubled = int(np.count_nonzero(exists)) - len(np.unique(keypoint[exists]))
    if not count and not doubled:
        return named.astype(np.int32), []
    if not repair:
        example = ""
        if disagree.any():
            at = int(np.flatnonzero(disagree)[0])
            frame = int(
                np.searchsorted(starts_of_counts(content.frames.keypoint_count), at, "right")
            )
            example = f", first in frame {to_hex(content.frames.id[frame - 1])}"
        raise MapError(
            f"frames and landmarks disagree about {count + doubled} observations{example}; "
            "load with --repair to keep what both say"
        )
    named[disagree] = -1
    return named.astype(np.int32), [f"{count + doubled} observations repaired or dropped"]


def _checked_count(frame: Any) -> int:
    """Return the number of keypoints of a frame whose sizes fit each other."""
    count, odd = divmod(len(frame.keypoints_px), 2)
    sizes = {name: (len(getattr(frame, name)), width) for name, width in _OPTIONAL.values()}
    wrong = [name for name, (size, width) in sizes.items() if size not in (0, width * count)]
    if odd:
        wrong.append("keypoints_px")
    if len(frame.descriptors) % max(count, 1) or (frame.descriptors and not count):
        wrong.append("descriptors")
    if wrong:
        name = to_hex(ids_of([frame.id], "id of a frame")[0])
        raise MapError(
            f"frame {name}: the size of {', '.join(wrong)} does not fit {count} keypoints"
        )
    return count


def _present(frame: Any) -> int:
    return sum(int(bit) for bit, (name, _) in _OPTIONAL.items() if len(getattr(frame, name)))


def _with_keypoints(table: Frames, frames: list[Any]) -> FrameContent:
    counts = table.keypoint_count
    total = int(counts.sum())
    widest = int(table.descriptor_size.max(initial=0))
    columns: dict[str, NDArray[Any]] = {
        "uv_px": np.empty((total, 2)),
        "sigma_px": np.full(total, 0.8),
        "scale": np.zeros(total),
        "track_id": np.full(total, -1, dtype=np.int32),
        "descriptor": np.zeros((total, widest), dtype=np.uint8),
        "position_3d": np.zeros((total, 0)),
        "time_offset_ns": np.zeros((total, 0), dtype=np.int32),
    }
    if (table.present & FrameField.POSITION_3D).any():
        columns["position_3d"] = np.zeros((total, 3))
    if (table.present & FrameField.TIME_OFFSET).any():
        columns["time_offset_ns"] = np.zeros((total, 1), dtype=np.int32)
    ids: list[U64] = []
    begin = 0
    for frame, count in zip(frames, counts.tolist(), strict=True):
        rows = slice(begin, begin + count)
        begin += count
        _fill(columns, rows, frame, count)
        own = frame.landmark_ids
        where = "landmark id of a keypoint"
        ids.append(ids_of(own, where) if len(own) else np.zeros((count, 2), dtype=np.uint64))
    numbers.finite(columns["uv_px"], "the position of a keypoint")
    return FrameContent(
        frames=table,
        keypoints=Keypoints.filled(total, **columns),
        landmark_ids=np.concatenate(ids) if ids else np.zeros((0, 2), dtype=np.uint64),
    )


def _fill(columns: dict[str, NDArray[Any]], rows: slice, frame: Any, count: int) -> None:
    if not count:
        return
    columns["uv_px"][rows] = np.array(frame.keypoints_px).reshape(-1, 2)
    if len(frame.sigmas_px):
        columns["sigma_px"][rows] = frame.sigmas_px
    if len(frame.scales):
        columns["scale"][rows] = frame.scales
    if len(frame.track_ids):
        columns["track_id"][rows] = frame.track_ids
    if len(frame.positions_3d):
        columns["position_3d"][rows] = np.array(frame.positions_3d).reshape(-1, 3)
    if len(frame.time_offsets_ns):
        columns["time_offset_ns"][rows, 0] = frame.time_offsets_ns
    if frame.descriptors:
        block = np.frombuffer(frame.descriptors, dtype=np.uint8).reshape(count, -1)
        columns["descriptor"][rows, : block.shape[1]] = block


def _joined(fields: list[Any]) -> I64:
    arrays = [np.array(field, dtype=np.int64) for field in fields]
    return np.concatenate(arrays) if arrays else np.zeros(0, dtype=np.int64)


def _objects(values: list[Any]) -> NDArray[Any]:
    column = np.empty(len(values), dtype=object)
    column[:] = values
    return column
