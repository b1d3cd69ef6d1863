"""Whether whole tracks observe the landmarks that they were matched with in one frame."""

import dataclasses

import numpy as np

from maplab_py.array_types import F64, Mask
from maplab_py.estimation.window import map_terms, map_tracks
from maplab_py.estimation.window.smoother import FixedLagSmoother
from maplab_py.sensors import Camera


def observed_throughout(
    matches: map_tracks.MapMatches,
    bases: list[F64],
    smoother: FixedLagSmoother,
    cameras: tuple[Camera, ...],
    T_I_C: F64,
    *,
    sigma_px: float,
) -> Mask:
    """Tell which tracks (M,) observe their landmarks in every frame of the window.

    A track that has come from another point observes its landmark in the matched frame only.

    Args:
        matches: Of tracks in the window.
        bases: Possible T_G_M, at least one: the first that explains all, else that which explains most.
        smoother: Poses, observations, and the gate.
        cameras: Of the rig.
        T_I_C: Their poses (C, 7).
        sigma_px: Standard deviation of a keypoint.
    """
    seen, used = map_tracks.MapTracks.of(matches).observations(smoother.tracks, sigma_px)
    options = smoother.options
    terms = map_terms.MapTerms(seen, cameras, T_I_C, huber_sigmas=options.huber_sigmas)
    far: list[Mask] = []
    for T_G_M in bases:
        states = dataclasses.replace(smoother.states, T_G_M=T_G_M[None])
        far.append(map_terms.contradicted(terms.errors_px(states), seen, options))
        if not far[-1].any():
            break
    result: Mask = np.ones(len(matches), dtype=np.bool_)
    result[used[min(far, key=np.count_nonzero)]] = False
    return result
