"""Convert the frames, keypoints, landmarks and observations of vertices to tables."""

import dataclasses
from itertools import chain
from typing import Any

import numpy as np

from maplab_py.array_types import I32, I64, U64, NDArray
from maplab_py.errors import MapError
from maplab_py.report import counted
from maplab_py.storage.protobuf import descriptor_layout, map_files, message_numbers
from maplab_py.storage.protobuf.ids import ids_of, ids_of_field, is_worth_a_kernel, unknown_bytes
from maplab_py.storage.protobuf.message_numbers import Name
from maplab_py.vimap import IdIndex, is_valid, tables, to_hex
from maplab_py.vimap.table import object_column, starts_of_counts

_OPTIONAL = {
    tables.FrameField.SIGMA: ("sigmas_px", 1),
    tables.FrameField.SCALE: ("scales", 1),
    tables.FrameField.TRACK_ID: ("track_ids", 1),
    tables.FrameField.POSITION_3D: ("positions_3d", 3),
    tables.FrameField.TIME_OFFSET: ("time_offsets_ns", 1),
    tables.FrameField.LANDMARK_ID: ("landmark_ids", 1),
}
_FILE_FIELDS = {"uv_px": "keypoints_px", "sigma_px": "sigmas_px", "scale": "scales"}


@dataclasses.dataclass(frozen=True, eq=False)
class FrameContent:
    """Frames with keypoints; landmarks of keypoints still as ids."""

    frames: tables.Frames
    keypoints: tables.Keypoints
    landmark_ids: U64  # (K, 2), zero = none
    name: Name  # file and id of a frame (row)


@dataclasses.dataclass(frozen=True, eq=False)
class ListedObservations:
    """The observations (O,) that landmarks list themselves."""

    observers: U64  # (O, 2) ids of vertices
    frame_index: I64
    keypoint_index: I64
    owner: I64  # row of the landmark


def read_frames(vertices: list[Any], vertex_name: Name, max_bytes: int) -> FrameContent:
    """Return the frames of all vertices (in row order) and their keypoints.

    Args:
        vertex_name: File and id of a vertex (row).
        max_bytes: Bound of the table of descriptors, unless at least half of it is descriptors.

    Raises:
        MapError: Sizes within a frame do not fit each other.
        MapError: Descriptors of different sizes would take more memory than the bound.
    """
    owned = [
        (row, camera, frame)
        for row, vertex in enumerate(vertices)
        for camera, frame in enumerate(vertex.nframe.frames)
    ]
    frames = [frame for _, _, frame in owned]

    def name(place: int) -> str:
        return f"{vertex_name(owned[place][0])}: frame {to_hex(ids[place])}"

    ids = ids_of([f.id for f in frames], "id of a frame", lambda k: vertex_name(owned[k][0]))
    counts = [_checked_count(frame, place, name) for place, frame in enumerate(frames)]
    present = [
        sum(int(bit) for bit, (name, _) in _OPTIONAL.items() if len(getattr(frame, name)))
        for frame in frames
    ]
    described = [_descriptors(frame, counts[k], k, name) for k, frame in enumerate(frames)]
    table = tables.Frames.filled(
        len(frames),
        id=ids,
        vertex=[row for row, _, _ in owned],
        camera_index=[camera for _, camera, _ in owned],
        timestamp_ns=[f.timestamp_ns for f in frames],
        is_valid=[f.is_valid if f.HasField("is_valid") else True for f in frames],
        keypoint_count=counts,
        present=present,
        descriptor_blocks=object_column([blocks for _, blocks in described]),
        descriptor_layout=[layout for layout, _ in described],
        unknown=object_column([unknown_bytes(f) for f in frames]),
    )
    return _with_keypoints(table, frames, name, max_bytes)


def read_landmarks(
    vertices: list[Any], vertex_name: Name
) -> tuple[tables.Landmarks, dict[str, U64 | I64]]:
    """Return landmarks by vertex row, and the columns of `ListedObservations`.

    Raises:
        MapError: The three lists of a landmark differ in length, or a number is not one.
    """
    if (read := _landmarks_in_bytes(vertices)) is not None:
        return read
    owned = [
        (row, lm) for row, vertex in enumerate(vertices) for lm in vertex.landmark_store.landmarks
    ]
    landmarks = [lm for _, lm in owned]
    counts = [len(lm.observer_vertex_ids) for lm in landmarks]

    ids = ids_of(
        [lm.id for lm in landmarks], "id of a landmark", lambda k: vertex_name(owned[k][0])
    )

    def name(place: int) -> str:
        return f"{vertex_name(owned[place][0])}: landmark {to_hex(ids[place])}"

    for place, (lm, count) in enumerate(zip(landmarks, counts, strict=True)):
        if not count == len(lm.keypoint_indices) == len(lm.frame_indices):
            raise MapError(f"{name(place)}: its three lists of observations differ in length")
    table = tables.Landmarks.filled(
        len(landmarks),
        id=ids,
        vertex=[row for row, _ in owned],
        p_I=message_numbers.finite(
            message_numbers.rows_or([lm.p_I for lm in landmarks], 3, 0.0, "position", name),
            "position",
            name,
        ),
        covariance=message_numbers.covariances(
            [lm.covariance for lm in landmarks], 3, "covariance", name
        ),
        quality=message_numbers.choices(
            [lm.quality for lm in landmarks], len(tables.LandmarkQuality), "quality", name
        ),
        feature_type=[lm.feature_type for lm in landmarks],
        unknown=object_column([unknown_bytes(lm) for lm in landmarks]),
    )
    observers, _ = ids_of_field(landmarks, "observer_vertex_ids", "observer_vertex_ids", name)
    return table, {
        "observers": observers,
        "frame_index": _joined([lm.frame_indices for lm in landmarks]),
        "keypoint_index": _joined([lm.keypoint_indices for lm in landmarks]),
        "owner": np.repeat(np.arange(len(counts)), counts),
    }


def _landmarks_in_bytes(
    vertices: list[Any],
) -> tuple[tables.Landmarks, dict[str, U64 | I64]] | None:
    """Return what `read_landmarks` does, read from bytes; None for few landmarks or irregular ones."""
    stores = [vertex.landmark_store for vertex in vertices]
    stored = np.array([len(store.landmarks) for store in stores], dtype=np.int64)
    if not is_worth_a_kernel(int(stored.sum())):
        return None
    from maplab_py.storage.protobuf.id_fields_kernel import landmark_columns, parts_of_field

    data = np.frombuffer(b"".join(s.SerializePartialToString() for s in stores), dtype=np.uint8)
    begin, end, is_regular = parts_of_field(data, 1)
    if not is_regular or len(begin) != stored.sum():
        return None
    *columns, lengths, observers, indices, is_regular = landmark_columns(data, begin, end)
    ids, numbers, kinds = columns
    p_I, covariance = (part.copy() for part in np.split(numbers.view(np.float64), [3], axis=1))
    is_known = (kinds[:, 0] >= 0) & (kinds[:, 0] < len(tables.LandmarkQuality))
    if not (is_regular and is_known.all() and np.isfinite(p_I).all()):
        return None
    table = tables.Landmarks.filled(
        len(ids),
        id=ids.byteswap(),
        vertex=np.repeat(np.arange(len(vertices)), stored),
        p_I=p_I,
        covariance=covariance.reshape(-1, 3, 3),
        quality=kinds[:, 0],
        feature_type=kinds[:, 1],
    )
    return table, {
        "observers": observers.byteswap(),
        "frame_index": indices[1],
        "keypoint_index": indices[0],
        "owner": np.repeat(np.arange(len(ids)), lengths[:, 0]),
    }


def linked_keypoints(
    content: FrameContent, landmark_index: IdIndex, listed: tuple[I64, I64], *, repair: bool
) -> tuple[NDArray[np.int32], list[str]]:
    """Merge the two copies of the observations: those of keypoints and those of landmarks.

    Args:
        content: Frames with the ids that they name.
        landmark_index: Rows of landmarks.
        listed: Keypoint and landmark rows (O,) of the landmarks' own lists; -1 = no such keypoint.
        repair: Keep the links in both copies and drop the rest instead of raising an error.

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
    times_listed = np.bincount(keypoint[exists], minlength=len(named))
    doubled = int(np.count_nonzero(exists)) - int(np.count_nonzero(times_listed))
    if not count and not doubled:
        return named.astype(np.int32), []
    if not repair:
        example = ""
        if disagree.any():
            at = int(np.flatnonzero(disagree)[0])
            starts = starts_of_counts(content.frames.keypoint_count)
            example = f"{content.name(int(np.searchsorted(starts, at, 'right')) - 1)}: "
        raise MapError(
            f"{example}frames and landmarks disagree about {counted(count + doubled, 'observation')}; "
            "load with --repair to keep the observations that both contain"
        )
    named[disagree] = -1
    return named.astype(np.int32), [
        f"{counted(count + doubled, 'observation')} repaired or dropped"
    ]


def _checked_count(frame: Any, place: int, name: Name) -> int:
    """Return the number of keypoints of a frame whose sizes fit each other."""
    count, odd = divmod(len(frame.keypoints_px), 2)
    sizes = {name: (len(getattr(frame, name)), width) for name, width in _OPTIONAL.values()}
    wrong = [name for name, (size, width) in sizes.items() if size not in (0, width * count)]
    if odd:
        wrong.append("keypoints_px")
    if wrong:
        raise MapError(
            f"{name(place)}: the size of {', '.join(wrong)} does not fit {count} keypoints"
        )
    return count


def _descriptors(
    frame: Any, count: int, place: int, name: Name
) -> tuple[tables.DescriptorLayout, descriptor_layout.Blocks | None]:
    try:
        return descriptor_layout.read_blocks(frame.descriptors, frame.descriptor_types, count)
    except MapError as error:
        raise MapError(f"{name(place)}: {error}; {map_files.COPY_AGAIN}") from error


def check_descriptor_table(table: tables.Frames, max_bytes: int) -> tuple[int, int]:
    """Return the shape (K, widest) of the table of descriptors.

    Raises:
        MapError: It would take more memory than the bound, and less than half of it is descriptors.
    """
    blocks = [block for frame_blocks in table.descriptor_blocks for block in frame_blocks or ()]
    stored = sum(block.keypoints * block.size for block in blocks)
    widest = max((block.size for block in blocks if block.keypoints), default=0)
    total = int(table.keypoint_count.sum())
    if total * widest > max(max_bytes, 2 * stored):
        raise MapError(
            f"{stored / 1e6:.0f} MB of descriptors of different sizes would take "
            f"{total * widest / 1e6:.0f} MB of memory; raise --proto_max_size_megabytes if the "
            "map is really that large"
        )
    return total, widest


def _landmark_ids(frames: list[Any], counts: I32, name: Name) -> U64:
    """Return the ids (K, 2) of the landmarks of all keypoints, zero = none."""
    where = "landmark id of a keypoint"
    ids, present = ids_of_field(frames, "landmark_ids", where, name)
    if np.array_equal(present, counts):
        return ids
    result = np.zeros((int(counts.sum()), 2), dtype=np.uint64)
    result[np.repeat(present > 0, counts)] = ids
    return result


def _with_keypoints(
    table: tables.Frames, frames: list[Any], name: Name, max_bytes: int
) -> FrameContent:
    counts = table.keypoint_count
    total = int(counts.sum())
    columns: dict[str, NDArray[Any]] = {
        "uv_px": np.empty((total, 2)),
        "sigma_px": np.full(total, 0.8),
        "scale": np.zeros(total),
        "track_id": np.full(total, -1, dtype=np.int32),
        "descriptor": np.zeros(check_descriptor_table(table, max_bytes), dtype=np.uint8),
        "position_3d": np.zeros((total, 0)),
        "time_offset_ns": np.zeros((total, 0), dtype=np.int32),
    }
    if (table.present & tables.FrameField.POSITION_3D).any():
        columns["position_3d"] = np.zeros((total, 3))
    if (table.present & tables.FrameField.TIME_OFFSET).any():
        columns["time_offset_ns"] = np.zeros((total, 1), dtype=np.int32)
    begin = 0
    for place, (frame, count) in enumerate(zip(frames, counts.tolist(), strict=True)):
        rows = slice(begin, begin + count)
        begin += count
        _fill(columns, rows, frame, count)
        if blocks := table.descriptor_blocks[place]:
            layout = int(table.descriptor_layout[place])
            descriptor_layout.unpack(frame.descriptors, layout, blocks, columns["descriptor"][rows])
    owner = np.repeat(np.arange(len(frames)), counts)
    for field in ("uv_px", "sigma_px", "scale"):
        values = columns[field].reshape(total, 2 if field == "uv_px" else 1)
        message_numbers.finite(values, _FILE_FIELDS[field], lambda row: name(int(owner[row])))
    return FrameContent(
        frames=table,
        keypoints=tables.Keypoints.filled(total, **columns),
        landmark_ids=_landmark_ids(frames, counts, name),
        name=name,
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


def _joined(fields: list[Any]) -> I64:
    return np.fromiter(chain.from_iterable(fields), np.int64, sum(map(len, fields)))
