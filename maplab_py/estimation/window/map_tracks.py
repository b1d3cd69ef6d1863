"""Tracks of a window that observe landmarks of a map."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.array_types import F64, I64, Mask, Rows
from maplab_py.estimation.window.map_terms import MapObservations
from maplab_py.estimation.window.tracks import Tracks


class MapMatches(Rows):
    """M tracks that each observe a landmark of the map; no track and no landmark occurs twice."""

    track_id: I64  # (M,)
    landmark: I64  # (M,) rows of the map
    p_G: F64  # (M, 3)
    covariance_G: F64 | None = None  # (M, 3, 3) [m^2]; None = landmarks are taken as exact

    @classmethod
    def none(cls, *, with_covariances: bool) -> MapMatches:
        """Return no matches."""
        ids = np.zeros(0, dtype=np.int64)
        return cls(ids, ids, np.zeros((0, 3)), np.zeros((0, 3, 3)) if with_covariances else None)


class MapTracks:
    """The associated tracks, and their present estimates of the landmarks.

    A track has one landmark and a landmark one track at a time, so that each keypoint and each landmark
    enters the estimate once. A track whose observations contradicted its landmark is not offered again.
    """

    def __init__(self, *, estimates_landmarks: bool) -> None:
        """Begin without associations; landmarks are estimated, or taken as exact."""
        self.matches = MapMatches.none(with_covariances=estimates_landmarks)
        self.p_G = np.zeros((0, 3))
        self._refused: I64 = np.zeros(0, dtype=np.int64)

    @classmethod
    def of(cls, matches: MapMatches) -> MapTracks:
        """Return associations with landmarks that are taken as exact."""
        result = cls(estimates_landmarks=False)
        result.matches = dataclasses.replace(matches, covariance_G=None)
        result.p_G = matches.p_G
        return result

    def __len__(self) -> int:
        return len(self.matches)

    def includes(self, track_id: I64) -> Mask:
        """Return which tracks (N,) are associated."""
        return np.isin(track_id, self.matches.track_id)

    def add(self, matches: MapMatches, tracks: Tracks) -> int:
        """Associate tracks in the window; return the number of new associations.

        Matches of tracks or landmarks that are associated already, or were refused, are left out.
        """
        is_new = np.isin(matches.track_id, tracks.id) & ~self.includes(matches.track_id)
        is_new &= ~np.isin(matches.landmark, self.matches.landmark)
        is_new &= ~np.isin(matches.track_id, self._refused)
        added = matches.take(is_new)
        self.matches = MapMatches.concatenate([self.matches, added])
        self.p_G = np.concatenate([self.p_G, added.p_G])
        return len(added)

    def forget(self, tracks: Tracks) -> None:
        """Remove the associations of tracks without observations in the window."""
        seen = tracks.id[tracks.counts() > 0]
        self._keep(np.isin(self.matches.track_id, seen))
        self._refused = self._refused[np.isin(self._refused, tracks.id)]

    def refuse(self, rows: I64) -> None:
        """Remove associations (rows) that the observations contradict."""
        self._refused = np.append(self._refused, self.matches.track_id[rows])
        kept: Mask = np.ones(len(self), dtype=np.bool_)
        kept[rows] = False
        self._keep(kept)

    def clear(self) -> None:
        """Remove all associations."""
        self._keep(np.zeros(len(self), dtype=np.bool_))

    def observations(
        self,
        tracks: Tracks,
        sigma_px: float,
        frame: int | None = None,
        chosen: I64 | None = None,
    ) -> tuple[MapObservations, I64]:
        """Return observations in the window, and the associations' rows (A,) that they belong to.

        Args:
            tracks: All tracks of the window.
            sigma_px: Standard deviation of a keypoint.
            frame: The only frame whose observations are wanted; None = all.
            chosen: The only associations (rows) whose observations are wanted; None = all.
        """
        chosen = np.arange(len(self)) if chosen is None else chosen
        rows = np.searchsorted(tracks.id, self.matches.track_id[chosen])
        order, start = tracks.grouped(rows)
        of = np.repeat(chosen, np.diff(start))
        if frame is not None:
            mine = tracks.observations.frame[order] == frame
            order, of = order[mine], of[mine]
        used, counts = np.unique(of, return_counts=True)
        seen = tracks.observations
        information = None
        if self.matches.covariance_G is not None:
            information = np.asarray(
                np.linalg.inv(self.matches.covariance_G[used]), dtype=np.float64
            )
        observations = MapObservations(
            np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
            seen.frame[order], seen.camera[order], seen.uv_px[order],
            np.full(len(order), sigma_px), self.matches.p_G[used], information,
        )  # fmt: skip
        return observations, used

    def _keep(self, kept: Mask) -> None:
        self.matches, self.p_G = self.matches.take(kept), self.p_G[kept]
