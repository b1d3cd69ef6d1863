"""The gap of a closed loop by one pose for a whole end of the walk: single poses are too noisy.

All camera rays of the later end, as the map has them, are one rigid bundle. The pose that lays this
bundle best onto points of the earlier end is the identity where the loop is closed; what it moves
the bundle's middle by is the gap. A robust loss takes care of wrong matches.
"""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.loop_closure.closure_table import Closures
from maplab_py.algorithms.loop_closure.features import map_features
from maplab_py.geometry import se3, so3
from maplab_py.geometry.triangulation import triangulate
from maplab_py.vimap import VIMap

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

EARLY_S, LATE_S = 15.0, 100.0
_MIN_EARLY_ANGLE_RAD = 0.03
_ROBUST_PX = 1.0
_PARTS = 10


@dataclasses.dataclass(frozen=True)
class JointGap:
    """How far one end of a walk is from where the points of the other want it."""

    observations: int
    landmarks: int
    gap_m: float  # shift of the middle of the later end
    gap_deg: float
    sigma_m: float  # of the gap, by leaving out tenths of the landmarks in turn (jackknife)
    rms_px: float  # of the observations that fit (below 3 px), after the shift


def merged_gap(vi_map: VIMap) -> JointGap:
    """Measure by landmarks that both ends observe, their points from early observations alone."""
    bundle = _Bundle(vi_map)
    early, late = bundle.time_s < EARLY_S, bundle.time_s > LATE_S
    label = bundle.label
    both = np.intersect1d(label[early & (label >= 0)], label[late & (label >= 0)])
    rows = np.flatnonzero(early & np.isin(label, both))
    rows = rows[np.argsort(label[rows], kind="stable")]
    owner, start = np.unique(label[rows], return_index=True)
    point, ok, angle = triangulate(
        bundle.origin_G[rows], bundle.ray_G[rows], np.append(start, len(rows))
    )
    good = ok & (angle > _MIN_EARLY_ANGLE_RAD)
    seen = np.flatnonzero(late & np.isin(label, owner[good]))
    return bundle.gap(seen, point[np.searchsorted(owner, label[seen])], label[seen])


def held_out_gap(vi_map: VIMap, closures: Closures) -> JointGap:
    """Measure by the inliers of closures: keypoints and landmarks that are not one in the map."""
    bundle = _Bundle(vi_map)
    row_of = np.full(len(vi_map.keypoints), -1)
    row_of[bundle.keypoint] = np.arange(len(bundle.keypoint))
    vertex = vi_map.keypoint_vertex
    first_seen = vi_map.vertices.timestamp_ns - vi_map.vertices.timestamp_ns[0]
    late = 1e-9 * first_seen[vertex[closures.keypoint]] > LATE_S
    keypoint, landmark = closures.keypoint[late], closures.landmark[late]
    pair = np.unique(np.stack([keypoint, landmark], axis=1), axis=0)
    return bundle.gap(row_of[pair[:, 0]], vi_map.p_G[pair[:, 1]], pair[:, 1])


class _Bundle:
    """All rays of a map in G, as its poses have them."""

    def __init__(self, vi_map: VIMap) -> None:
        features, _ = map_features(vi_map, np.arange(len(vi_map.missions)))
        T_G_I = vi_map.T_G_I[features.vertex]
        self.keypoint, self.label = features.keypoint, features.descriptors.label
        self.origin_G = se3.transform(T_G_I, features.origin_I)
        self.ray_G = so3.rotate(T_G_I[:, :4], features.ray_I)
        self.rad_per_px = features.rad_per_px
        time_ns = features.descriptors.time_ns
        self.time_s = 1e-9 * (time_ns - time_ns.min())

    def gap(self, rows: I64, point_G: F64, group: I64) -> JointGap:
        """Fit the pose of the rays of some rows to points, whole and with parts left out."""
        middle = self.origin_G[rows].mean(axis=0)
        data = (
            self.origin_G[rows] - middle, self.ray_G[rows], point_G - middle, self.rad_per_px[rows]
        )  # fmt: skip
        step = _fit(*data)
        order = np.unique(group, return_inverse=True)[1]
        part = np.random.default_rng(0).permutation(order.max() + 1)[order] % _PARTS
        shifts = np.array(
            [_fit(*(column[part != p] for column in data))[:3] for p in range(_PARTS)]
        )
        spread = (_PARTS - 1) / _PARTS * np.sum((shifts - shifts.mean(axis=0)) ** 2)
        error = np.linalg.norm(_errors_px(step, *data), axis=1)
        fits = error < 3.0
        return JointGap(
            len(rows), int(order.max()) + 1, float(np.linalg.norm(step[:3])),
            float(np.degrees(np.linalg.norm(step[3:]))), float(np.sqrt(spread)),
            float(np.sqrt(np.mean(error[fits] ** 2))),
        )  # fmt: skip


def _errors_px(step: F64, origin: F64, ray: F64, point: F64, rad_per_px: F64) -> F64:
    """Return cross products (N, 3) of rays and directions to points [px] after moving the rays."""
    turn = so3.exp(step[3:])
    direction = point - (so3.rotate(turn, origin) + step[:3])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return np.asarray(np.cross(so3.rotate(turn, ray), direction) / rad_per_px[:, None])


def _fit(origin: F64, ray: F64, point: F64, rad_per_px: F64) -> F64:
    """Return shift [m] and turn [rad] (6,) of a bundle of rays: iteratively reweighted (Cauchy)."""
    step = np.zeros(6)
    for _ in range(50):
        error = _errors_px(step, origin, ray, point, rad_per_px)
        J = np.empty((*error.shape, 6))
        for column in range(6):
            moved = step.copy()
            moved[column] += 1e-6
            J[:, :, column] = 1e6 * (_errors_px(moved, origin, ray, point, rad_per_px) - error)
        weight = 1.0 / (1.0 + np.sum(error**2, axis=1) / _ROBUST_PX**2)
        H = np.einsum("nia,nib,n->ab", J, J, weight)
        change = -np.linalg.solve(H, np.einsum("nia,ni,n->a", J, error, weight))
        step += change
        if np.abs(change).max() < 1e-8:
            break
    return step
