"""Model of binary descriptors: signs of correlated activations that vary with view and session.

A point has a latent vector z, which varies with view direction, distance and session. Bit i is the
sign of w_i . z + noise. Bits with an activation near zero therefore flip first, near views have
similar descriptors, and bits that compare similar image regions flip together, as in BRISK or FREAK.
Some observations are much noisier than others (blur, borders, a shifted keypoint). With the
defaults, distances of equal and of different points match maps that maplab recorded with BRISK:
medians of 51 and 178 bits out of 384.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.array_types import F32, I64
from maplab_py.simulation.detection import Detections
from maplab_py.simulation.scenario import AppearanceOptions

_REFERENCE_DISTANCE_M = 3.0
_DETECTIONS_AT_ONCE = 1 << 14
"""Number of descriptors per batch; bounds the memory to about 100 MB."""


@dataclasses.dataclass(frozen=True, eq=False)
class Appearance:
    """Appearance of all points of a world. Activations have unit variance over points."""

    options: AppearanceOptions
    weights: F32  # (latent, bits)
    threshold: F32  # (bits,) of the activations: some bits are mostly set, others mostly clear
    look: I64  # (L,) row of the following for every point of the world
    latent: F32  # (K, latent)
    gradient: F32  # (K, 4, latent) by view direction (3) and doubling of the distance


@dataclasses.dataclass(frozen=True, eq=False)
class SessionAppearance:
    """Appearance and presence of points in a session."""

    world: Appearance
    change: F32  # (K, latent)
    is_there: NDArray[np.bool_]  # (L,)


def make_appearance(options: AppearanceOptions, look: I64, rng: np.random.Generator) -> Appearance:
    """Draw the appearance of the points; points of equal `look` (L,) have the same appearance."""
    points = int(look.max(initial=-1)) + 1
    bits, size = 8 * options.descriptor_bytes, options.latent_dimensions
    weights = rng.standard_normal((size, bits), dtype=np.float32)
    weights /= np.linalg.norm(weights, axis=0)
    threshold = options.bit_bias * rng.standard_normal(bits, dtype=np.float32)
    latent = rng.standard_normal((points, size), dtype=np.float32)
    gradient = rng.standard_normal((points, 4, size), dtype=np.float32)
    gradient[:, :3] *= options.viewpoint_change
    gradient[:, 3] *= options.scale_change
    return Appearance(options, weights, threshold, look, latent, gradient)


def make_session_appearance(world: Appearance, rng: np.random.Generator) -> SessionAppearance:
    """Draw the changed appearance and the missing points of a session."""
    change = rng.standard_normal(world.latent.shape, dtype=np.float32)
    change *= world.options.session_change
    is_there = rng.uniform(size=len(world.look)) >= world.options.vanish_share
    return SessionAppearance(world, change, is_there)


def describe(
    session: SessionAppearance, detections: Detections, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Return the descriptors (N, bytes) of detections."""
    size = session.world.options.descriptor_bytes
    descriptors = np.empty((len(detections.frame), size), dtype=np.uint8)
    for first in range(0, len(detections.frame), _DETECTIONS_AT_ONCE):
        rows = slice(first, first + _DETECTIONS_AT_ONCE)
        descriptors[rows] = _describe(session, detections, rows, rng)
    return descriptors


def _describe(
    session: SessionAppearance, detections: Detections, rows: slice, rng: np.random.Generator
) -> NDArray[np.uint8]:
    world = session.world
    point = detections.point[rows]
    view = np.concatenate(
        [
            detections.view_G[rows],
            np.log2(detections.distance_m[rows, None] / _REFERENCE_DISTANCE_M),
        ],
        axis=1,
    ).astype(np.float32)
    # clutter has point -1: its latent vector is drawn separately
    latent = rng.standard_normal((len(point), world.latent.shape[1]), dtype=np.float32)
    of_point = point >= 0
    known = world.look[point[of_point]]
    latent[of_point] = world.latent[known] + session.change[known]
    latent[of_point] += np.einsum("nk,nkj->nj", view[of_point], world.gradient[known])
    activation = latent @ world.weights
    noise = rng.standard_normal(activation.shape, dtype=np.float32)
    spread = rng.standard_normal((len(point), 1), dtype=np.float32)
    noise *= world.options.bit_noise * np.exp(world.options.bit_noise_spread * spread)
    return np.packbits(activation + noise > world.threshold, axis=1)
