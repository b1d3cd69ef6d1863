"""Tracks in the window, their observations, and estimates of tracks that are landmarks."""

import dataclasses

import numpy as np

from maplab_py.array_types import F64, I32, I64, Mask, Rows, mask_of
from maplab_py.estimation.kernels import window as kernels
from maplab_py.estimation.kernels.window_arguments import WindowData
from maplab_py.estimation.window.cameras import CameraPoses

_NONE = -1
_MEMORY = 10
"""Frames without an observation after which a closed track is forgotten."""
_COLUMNS = (
    "id", "is_landmark", "is_closed", "is_persistent",
    "anchor_frame", "anchor_camera", "h", "expected", "last_seen",
)  # fmt: skip


class Observations(Rows):
    """O observations in the order of time."""

    row: I64  # (O,) of the tracks
    frame: I32  # (O,) of the window, ascending
    camera: I32  # (O,)
    uv_px: F64  # (O, 2)
    sigma_px: F64  # (O,)
    ray_C: F64  # (O, 3) unit vectors


class Tracks:
    """T tracks by ascending id, and their observations.

    A landmark is a track with an estimate h in the camera of its anchor, its first observation in the window.
    A closed track takes no more observations. A persistent one stays until it ends (policy of the thesis).
    """

    def __init__(self) -> None:
        self.id: I64 = np.zeros(0, dtype=np.int64)
        self.is_landmark: Mask = np.zeros(0, dtype=np.bool_)
        self.is_closed: Mask = np.zeros(0, dtype=np.bool_)
        self.is_persistent: Mask = np.zeros(0, dtype=np.bool_)
        self.anchor_frame: I32 = np.zeros(0, dtype=np.int32)
        self.anchor_camera: I32 = np.zeros(0, dtype=np.int32)
        self.h: F64 = np.zeros((0, 3))
        self.expected: F64 = np.zeros((0, 2))  # 1/z, and the inverse of its deviation
        self.last_seen: I64 = np.zeros(0, dtype=np.int64)
        self._clock = 0
        integers, reals = np.zeros(0, dtype=np.int32), np.zeros(0)
        self.observations = Observations(
            np.zeros(0, dtype=np.int64), integers, integers,
            np.zeros((0, 2)), reals, np.zeros((0, 3)),
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.id)

    @property
    def landmark_rows(self) -> I64:
        """Rows of the tracks that are landmarks."""
        return np.flatnonzero(self.is_landmark)

    def add(self, frames: range, track_id: I64, seen: Observations) -> None:
        """Add the observations of consecutive new frames; `seen.row` need not be set."""
        self._insert(self._unknown(track_id))
        row = np.searchsorted(self.id, track_id)
        self.last_seen[row] = self._clock + 1 + seen.frame - frames.start
        self._clock += len(frames)
        new = dataclasses.replace(seen, row=row).take(~self.is_closed[row])
        self.observations = Observations.concatenate([self.observations, new])

    def replace_rays(self, ray_C: F64) -> None:
        """Replace the rays (O, 3) of the observations; landmarks move with those of their anchors."""
        seen = self.observations
        is_anchor = seen.frame == self.anchor_frame[seen.row]
        is_anchor &= seen.camera == self.anchor_camera[seen.row]
        row, after, before = seen.row[is_anchor], ray_C[is_anchor], seen.ray_C[is_anchor]
        self.h[row, :2] += after[:, :2] / after[:, 2:] - before[:, :2] / before[:, 2:]
        self.observations = dataclasses.replace(seen, ray_C=ray_C)

    def counts(self) -> I64:
        """Return the number of observations (T,)."""
        return np.bincount(self.observations.row, minlength=len(self))

    def candidates(self, is_allowed: Mask | bool, length: int | None) -> I64:
        """Return allowed tracks (rows) that may become landmarks: continuing ones first, then by length.

        Without them the newest frames would hang on samples alone.

        Args:
            is_allowed: (T,) or all.
            length: Tracks of fewer frames wait until they end; None = they do not.
        """
        counts = self.counts()
        is_candidate = ~self.is_landmark & ~self.is_closed & (counts >= 2) & is_allowed
        if length is not None:
            is_candidate &= (self.num_frames() >= length) | ~self.is_active
        rows = np.flatnonzero(is_candidate)
        return rows[np.lexsort((-counts[rows], ~self.is_active[rows]))]

    @property
    def is_active(self) -> Mask:
        """Return which tracks (T,) the newest frame observes."""
        return np.asarray(self.last_seen == self._clock)

    @property
    def num_active_landmarks(self) -> int:
        """Number of landmarks that the newest frame observes."""
        return int(np.count_nonzero(self.is_landmark & self.is_active))

    def num_frames(self) -> I64:
        """Return how many frames of the window observe each track (T,)."""
        seen = self.observations
        pairs = np.unique(seen.row * (int(seen.frame.max(initial=0)) + 1) + seen.frame)
        rows = pairs // (int(seen.frame.max(initial=0)) + 1)
        return np.bincount(rows, minlength=len(self))

    def is_seen_by(self, frame: int) -> Mask:
        """Return which tracks (T,) a frame observes."""
        return mask_of(len(self), self.observations.row[self.observations.frame == frame])

    def grouped(self, rows: I64) -> tuple[I64, I64]:
        """Return observations of some tracks (R,), track after track, and their offsets (R + 1,)."""
        order = np.empty(len(self.observations), dtype=np.int64)
        start = np.empty(len(rows) + 1, dtype=np.int64)
        kernels.group(self.observations.row, rows, len(self), order, start)
        return order[: start[-1]], start

    def data(self, rows: I64, huber_sigmas: float) -> tuple[WindowData, I64]:
        """Return the kernels' arguments of some tracks (R,), and the rows (O',) of their observations."""
        order, start = self.grouped(rows)
        seen = self.observations
        data = WindowData(
            start,
            seen.frame[order],
            seen.camera[order],
            seen.uv_px[order],
            1.0 / seen.sigma_px[order],
            np.full(len(order), huber_sigmas * huber_sigmas),
            self.anchor_frame[rows],
            self.anchor_camera[rows],
            self.expected[rows],
        )
        return data, order

    def points(self, rows: I64, poses: CameraPoses) -> F64:
        """Return the places p_M (R, 3) of landmarks."""
        h = self.h[rows]
        p_C = np.concatenate([h[:, :2], np.ones((len(rows), 1))], axis=1) / h[:, 2:]
        return poses.to_mission(self.anchor_frame[rows], self.anchor_camera[rows], p_C)

    def make_landmarks(self, rows: I64, p_M: F64, poses: CameraPoses) -> None:
        """Give tracks (R,) the places p_M (R, 3), anchored where they were first seen."""
        first = self._first_observation()[rows]
        seen = self.observations
        frame, camera = seen.frame[first], seen.camera[first]
        p_C = poses.to_camera(frame, camera, p_M)
        in_front = p_C[:, 2] > 0.0
        depth = np.where(in_front, p_C[:, 2], 1.0)
        self.h[rows, :2] = p_C[:, :2] / depth[:, None]
        self.h[rows, 2] = 1.0 / depth
        self.anchor_frame[rows], self.anchor_camera[rows] = frame, camera
        self.is_landmark[rows] = in_front

    def expect(self, rows: I64, inverse_depth: float, share: float) -> None:
        """Make landmarks of tracks (R,) whose depth is not known but expected.

        Args:
            rows: The tracks.
            inverse_depth: Expected 1/z [1/m] in the camera of the anchor.
            share: Standard deviation of it, as a share of it.
        """
        first = self._first_observation()[rows]
        seen = self.observations
        self.anchor_frame[rows], self.anchor_camera[rows] = seen.frame[first], seen.camera[first]
        ray_C = seen.ray_C[first]
        in_front = ray_C[:, 2] > 0.0
        self.h[rows, :2] = ray_C[:, :2] / np.where(in_front, ray_C[:, 2], 1.0)[:, None]
        self.h[rows, 2] = inverse_depth
        self.expected[rows] = inverse_depth, 1.0 / (share * inverse_depth)
        self.is_landmark[rows] = in_front

    def remove_observations(self, is_removed: Mask, poses: CameraPoses) -> None:
        """Remove observations (O,); anchor landmarks again that lost their first.

        Landmarks with fewer than two observations become tracks without an estimate, tracks without
        observations are forgotten unless they are closed.
        """
        before = self._first_observation()
        anchor = np.where(before >= 0, before, 0)
        lost = is_removed[anchor] & self.is_landmark if len(is_removed) else self.is_landmark
        rows = np.flatnonzero(lost)
        p_M = self.points(rows, poses)
        self.observations = self.observations.take(~is_removed)
        self.is_landmark &= self.counts() >= 2
        kept = self.is_landmark[rows]
        self.make_landmarks(rows[kept], p_M[kept], poses)

    def make_persistent(self, wanted: int) -> None:
        """Make the most observed landmarks that are still tracked persistent, up to the wanted number."""
        may_stay = self.is_landmark & self.is_active
        self.is_persistent &= may_stay
        others = np.flatnonzero(may_stay & ~self.is_persistent)
        order = np.argsort(-self.counts()[others], kind="stable")
        room = wanted - np.count_nonzero(self.is_persistent)
        self.is_persistent[others[order[: max(room, 0)]]] = True

    def remove_frame(self, frame: int, poses: CameraPoses, rows: I64 | None = None) -> None:
        """Remove a frame with its observations, and those of some tracks; later frames move down."""
        is_removed = self.observations.frame == frame
        if rows is not None:
            is_removed |= self._mask_of(rows)[self.observations.row]
            self.is_landmark[rows] = False
        self.remove_observations(is_removed, poses)
        self._forget()
        seen = self.observations.frame
        seen = np.where(seen > frame, seen - 1, seen).astype(np.int32)
        self.observations = dataclasses.replace(self.observations, frame=seen)
        later = self.anchor_frame > frame
        self.anchor_frame[later] -= 1

    def remove_tracks(self, rows: I64, poses: CameraPoses, *, close: bool) -> None:
        """Remove all observations of some tracks; closed ones take no more."""
        self.is_landmark[rows] = False
        self.is_closed[rows] |= close
        self.remove_observations(self._mask_of(rows)[self.observations.row], poses)

    def _mask_of(self, rows: I64) -> Mask:
        return mask_of(len(self), rows)

    def _unknown(self, track_id: I64) -> I64:
        """Return ids that no track has, ascending, each once."""
        if not len(self):
            return np.unique(track_id)
        row = np.minimum(np.searchsorted(self.id, track_id), len(self) - 1)
        return np.unique(track_id[self.id[row] != track_id])

    def _first_observation(self) -> I64:
        first = np.full(len(self), _NONE, dtype=np.int64)
        count = len(self.observations)
        first[self.observations.row[::-1]] = np.arange(count)[::-1]
        return first

    def _insert(self, ids: I64) -> None:
        """Add tracks without observations."""
        if not len(ids):
            return
        order: I64 | slice = slice(None)
        if len(self) and ids[0] < self.id[-1]:
            order = np.argsort(np.concatenate([self.id, ids]), kind="stable")
            place = np.empty_like(order)
            place[order] = np.arange(len(order))
            self.observations = dataclasses.replace(
                self.observations, row=place[self.observations.row]
            )
        for name in _COLUMNS:
            column = getattr(self, name)
            added = np.zeros((len(ids), *column.shape[1:]), column.dtype) if name != "id" else ids
            setattr(self, name, np.concatenate([column, added])[order])

    def _forget(self) -> None:
        """Remove tracks without observations, closed ones when they have ended."""
        kept = (self.counts() > 0) | (self.is_closed & (self.last_seen > self._clock - _MEMORY))
        if kept.all():
            return
        self.observations = dataclasses.replace(
            self.observations, row=(np.cumsum(kept) - 1)[self.observations.row]
        )
        for name in _COLUMNS:
            setattr(self, name, getattr(self, name)[kept])
