"""Evidence for landmarks: in which sessions they were predicted visible, and matched.

It is stored in a field of the landmark's message that other programs skip. Sessions are counted, and within a
session places, not images: images of one place fail for the same reason.
"""

from typing import Any

import numpy as np

from maplab_py.array_types import I64, Mask, NDArray, Rows
from maplab_py.errors import MapError
from maplab_py.storage.extension_fields import read_extension, with_extension
from maplab_py.vimap import VIMap

LANDMARK_EVIDENCE = 1000
"""Number of the field in the landmark message."""
RECENT = 8
"""Sessions that are kept one by one; older ones are summarised, so that a landmark keeps its size."""
_ENTRY = np.dtype([("time_s", "<u4"), ("predicted", "u1"), ("matched", "u1")])
RECORD = np.dtype(
    [
        ("born_s", "<u4"),  # begin of the first session that observed it [s since 1970]
        ("time_s", "<u4"),  # begin of the last session that is summarised
        ("hits", "<u2"),  # summarised sessions in which it was matched
        ("misses", "<u2"),  # and in which it was predicted only
        ("vanished", "<f4"),  # log probability of these and of having vanished before the last
        ("recent", _ENTRY, (RECENT,)),  # the oldest first; time_s 0 = none
    ]
)
"""Evidence of one landmark; `born_s` 0 = none."""
NEVER = np.float32(-1e30)


class Session(Rows):
    """Outcome of one session for landmarks (N,)."""

    time_s: int  # begin, since 1970
    landmark: I64  # rows, each once
    predicted: I64  # number of places from which it should have been seen
    matched: I64  # number of places from which it was seen


def read_evidence(vi_map: VIMap) -> NDArray[Any]:
    """Return the evidence (L,) of all landmarks.

    Raises:
        MapError: The evidence of a landmark is damaged.
    """
    contents = [
        read_extension(unknown, LANDMARK_EVIDENCE) if unknown else None
        for unknown in vi_map.landmarks.unknown.tolist()
    ]
    empty = no_evidence(1).tobytes()
    rows = [empty if content is None else content for content in contents]
    if any(len(row) != RECORD.itemsize for row in rows):
        raise MapError(
            f"the evidence of landmarks is damaged or of a newer version ({RECORD.itemsize} bytes "
            "are expected): gather_evidence --forget removes it"
        )
    return np.frombuffer(b"".join(rows), dtype=RECORD).copy()


def with_evidence(vi_map: VIMap, evidence: NDArray[Any] | None) -> VIMap:
    """Return the map with the evidence (L,) of its landmarks; None removes it."""
    before = vi_map.landmarks.unknown.tolist()
    if evidence is None:
        rows: list[bytes | None] = [None] * len(before)
    else:
        known = (evidence["born_s"] > 0).tolist()
        rows = [row.tobytes() if k else None for row, k in zip(evidence, known, strict=True)]
    unknown = np.empty(len(before), dtype=object)
    unknown[:] = [
        with_extension(old, LANDMARK_EVIDENCE, row) if old or row else b""
        for old, row in zip(before, rows, strict=True)
    ]
    return vi_map.replace(landmarks=vi_map.landmarks.replace(unknown=unknown))


def no_evidence(count: int) -> NDArray[Any]:
    """Return empty records (count,)."""
    records = np.zeros(count, dtype=RECORD)
    records["vanished"] = NEVER
    return records


def has_evidence(vi_map: VIMap) -> bool:
    """Return whether any landmark may have evidence."""
    return any(vi_map.landmarks.unknown.tolist())


def add_session(evidence: NDArray[Any], session: Session) -> tuple[NDArray[Any], Mask]:
    """Add a session in the order of time; places of a session that is known already are united.

    A session that may be part of a summary, or is older than all sessions of a full record, is left out.

    Returns:
        The evidence, and the records (L,) that are full: their oldest session must be summarised first.
    """
    evidence = evidence.copy()
    recent = evidence["recent"]
    counts = session.time_s > evidence["time_s"][session.landmark]
    session = session.take(counts & (session.time_s >= recent["time_s"][session.landmark, 0]))
    rows = session.landmark
    same = recent["time_s"][rows] == session.time_s
    known = same.any(axis=1)
    full = np.zeros(len(evidence), dtype=np.bool_)
    full[rows] = ~known & (recent["time_s"][rows, 0] > 0)
    shifted = rows[~known]
    recent[shifted, :-1] = recent[shifted, 1:]
    recent["time_s"][shifted, -1] = session.time_s
    recent["predicted"][shifted, -1] = np.minimum(session.predicted[~known], 255)
    recent["matched"][shifted, -1] = np.minimum(session.matched[~known], 255)
    column = np.argmax(same, axis=1)[known]
    for name, values in (("predicted", session.predicted), ("matched", session.matched)):
        old = recent[name][rows[known], column]
        recent[name][rows[known], column] = np.maximum(old, np.minimum(values[known], 255))
    evidence["recent"] = _in_order(recent)
    return evidence, full


def with_inherited(vi_map: VIMap, absorbed: I64, survivor: I64) -> VIMap:
    """Return the map in which survivors (N,) have the evidence of absorbed landmarks (N,), too."""
    if len(absorbed) == 0 or not has_evidence(vi_map):
        return vi_map
    return with_evidence(vi_map, inherit(read_evidence(vi_map), absorbed, survivor))


def inherit(evidence: NDArray[Any], absorbed: I64, survivor: I64) -> NDArray[Any]:
    """Return the evidence (L,) after landmarks (N,) were merged into others (N,).

    The survivor inherits both histories: a session in which either was matched counts as matched. Summaries
    may hold the same sessions: that with more matches stays, and no session of its period is added to it.
    """
    evidence = evidence.copy()
    wanted = evidence["born_s"][absorbed] > 0
    absorbed, survivor = absorbed[wanted], survivor[wanted]
    while len(absorbed):
        _, first = np.unique(survivor, return_index=True)
        evidence[survivor[first]] = _united(evidence[survivor[first]], evidence[absorbed[first]])
        rest = np.setdiff1d(np.arange(len(absorbed)), first)
        absorbed, survivor = absorbed[rest], survivor[rest]
    return evidence


def _united(a: NDArray[Any], b: NDArray[Any]) -> NDArray[Any]:
    """Return the histories (N,) of two records each as one."""
    sessions = [record["hits"].astype(np.int64) + record["misses"] for record in (a, b)]
    is_better = (b["hits"] > a["hits"]) | ((b["hits"] == a["hits"]) & (sessions[1] > sessions[0]))
    result = np.where(is_better, b, a)
    is_new = a["born_s"] == 0
    result["born_s"] = np.where(is_new, b["born_s"], np.minimum(a["born_s"], b["born_s"]))
    entries = _in_order(np.concatenate([a["recent"], b["recent"]], axis=1))
    times = entries["time_s"]
    same = (times[:, 1:] == times[:, :-1]) & (times[:, 1:] > 0)
    for name in ("predicted", "matched"):  # of equal times the later one gets both
        both = np.maximum(entries[name][:, 1:], entries[name][:, :-1])
        entries[name][:, 1:] = np.where(same, both, entries[name][:, 1:])
    times[:, :-1][same] = 0
    times[times <= result["time_s"][:, None]] = 0
    result["recent"] = _in_order(entries)[:, -RECENT:]
    return result


def _in_order(entries: NDArray[Any]) -> NDArray[Any]:
    """Return the sessions of records (L, N) in the order of time."""
    order = np.argsort(entries["time_s"], axis=1, kind="stable")
    return np.take_along_axis(entries, order, axis=1)


def birth_times_s(vi_map: VIMap) -> I64:
    """Return the begin (L,) of the first session that observes each landmark [s since 1970]."""
    start = session_times_s(vi_map)
    keypoints = vi_map.observations
    times = start[vi_map.vertices.mission[vi_map.keypoint_vertex[keypoints]]]
    born = start[vi_map.vertices.mission[vi_map.landmarks.vertex]]
    np.minimum.at(born, vi_map.keypoints.landmark[keypoints], times)
    return np.asarray(born)


def session_times_s(vi_map: VIMap) -> I64:
    """Return the begin (M,) of each mission [s since 1970], at least 1."""
    first = np.minimum(vi_map.vertex_start[:-1], max(len(vi_map.vertices) - 1, 0))
    seconds = vi_map.vertices.timestamp_ns[first] // 1_000_000_000
    return np.asarray(np.clip(seconds, 1, 2**32 - 1))
