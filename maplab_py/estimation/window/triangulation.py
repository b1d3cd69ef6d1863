"""Triangulation of tracks into landmarks: enough parallax, and errors that agree with their uncertainty."""

from types import ModuleType

import numpy as np

from maplab_py.array_types import F64, I32, I64, Mask
from maplab_py.estimation.kernels import window as kernels
from maplab_py.estimation.kernels.window_arguments import WindowPoint
from maplab_py.estimation.window.cameras import CameraPoses
from maplab_py.estimation.window.options import WindowOptions
from maplab_py.estimation.window.tracks import Tracks


class Triangulator:
    """Turns tracks into landmarks."""

    def __init__(self, kernels: ModuleType, options: WindowOptions) -> None:
        """Take the kernels of the template `window`."""
        self._kernels, self._options = kernels, options

    def add_landmarks(
        self,
        tracks: Tracks,
        candidates: I64,
        at: WindowPoint,
        *,
        only_stereo: bool,
        num_best: int | None = None,
    ) -> I64:
        """Make landmarks of those candidates (rows of tracks) that can be.

        Args:
            tracks: All tracks; changed.
            candidates: Rows without an estimate, the most wanted first.
            at: Frames and cameras; whatever landmarks.
            only_stereo: The body only turned: rays from the same frame count alone.
            num_best: Take so many with the best score, parallax over distance; None = the first.

        Returns:
            Rows of the candidates without enough parallax; none when there is no room for more landmarks.
        """
        options = self._options
        room = options.max_landmarks - tracks.num_active_landmarks
        if room <= 0 or not len(candidates):
            return candidates[:0]
        poses = CameraPoses.of(at.T_M_I, at.cameras.T_I_C)
        order, start = tracks.grouped(candidates)
        seen = tracks.observations.take(order)
        rays_M = poses.rays(seen.frame, seen.camera, seen.ray_C)
        parallax = self._parallax_deg(rays_M, seen.frame, start, only_stereo=only_stereo)
        is_wide = parallax >= options.min_parallax_deg
        wide = np.flatnonzero(is_wide)
        narrow = candidates[~is_wide]
        wide = wide[:room] if num_best is None else wide
        rows, parallax = candidates[wide], parallax[wide]
        if not len(rows):
            return narrow
        p_M, ok = _triangulated(tracks, rows, poses)
        rows, p_M, parallax = rows[ok], p_M[ok], parallax[ok]
        tracks.make_landmarks(rows, p_M, poses)
        tracks.is_landmark[rows] &= self._is_good(tracks, rows, at)
        if num_best is not None:
            score = np.where(tracks.is_landmark[rows], parallax * tracks.h[rows, 2], 0.0)
            tracks.is_landmark[rows[np.argsort(-score, kind="stable")[num_best:]]] = False
        return narrow

    def _parallax_deg(self, rays: F64, frame: I32, start: I64, *, only_stereo: bool) -> F64:
        """Return the largest angle (R,) between the first ray and others of every track."""
        counts = np.diff(start)
        first = np.repeat(start[:-1], counts)
        chord = np.linalg.norm(rays - rays[first], axis=1)
        if only_stereo:
            chord[frame != frame[first]] = 0.0
        angle = 2.0 * np.arcsin(np.minimum(0.5 * chord, 1.0))
        result = np.zeros(len(counts))
        filled = counts > 0
        result[filled] = np.maximum.reduceat(angle, start[:-1][filled])
        return np.degrees(result)

    def _is_good(self, tracks: Tracks, rows: I64, at: WindowPoint) -> Mask:
        """Return which landmarks (R,) have depths and errors within their limits."""
        options = self._options
        data, _ = tracks.data(rows, options.huber_sigmas)
        error_depth = np.empty((len(data.frame), 2))
        self._kernels.evaluate(data, at._replace(h=tracks.h[rows]), error_depth)
        error, depth = error_depth.T
        fits = (error * data.inverse_sigma) ** 2 <= options.gate_chi2
        fits &= (depth >= options.min_depth_m) & (depth <= options.max_depth_m)
        result: Mask = np.ones(len(rows), dtype=np.bool_)
        result[np.repeat(np.arange(len(rows)), np.diff(data.start))[~fits]] = False
        return result & tracks.is_landmark[rows]


def _triangulated(tracks: Tracks, rows: I64, poses: CameraPoses) -> tuple[F64, Mask]:
    """Return the points (R, 3) of tracks, and whether they are determined (R,)."""
    order, start = tracks.grouped(rows)
    seen = tracks.observations.take(order)
    rays_M = poses.rays(seen.frame, seen.camera, seen.ray_C)
    p_M, is_determined = np.empty((len(rows), 3)), np.empty(len(rows), dtype=np.bool_)
    origins = poses.p_M_C[seen.frame, seen.camera]
    kernels.triangulate(origins, rays_M, start, p_M, is_determined)
    return p_M, is_determined
