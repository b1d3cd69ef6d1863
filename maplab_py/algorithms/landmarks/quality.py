"""Which landmarks are well constrained (maplab's rules)."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.landmarks.options import LandmarkQualityOptions
from maplab_py.algorithms.landmarks.reports import LandmarkQualityReport
from maplab_py.algorithms.landmarks.sightings import is_lidar, rays_in_G, residuals
from maplab_py.geometry.triangulation import largest_ray_angle
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import LandmarkQuality, VIMap
from maplab_py.vimap.queries import landmark_mask
from maplab_py.vimap.table import ragged_rows, starts_of_counts

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclasses.dataclass(frozen=True, eq=False)
class Verdict:
    """Reasons (L,) against each of some landmarks."""

    too_few_observers: Mask
    too_small_angle: Mask
    too_near_or_behind: Mask
    too_far: Mask
    too_large_error: Mask

    @property
    def is_good(self) -> Mask:
        """Landmarks without a reason against them."""
        reasons = [getattr(self, field.name) for field in dataclasses.fields(self)]
        return np.asarray(~np.any(reasons, axis=0))


def evaluate_quality(
    vi_map: VIMap,
    options: LandmarkQualityOptions,
    *,
    missions: NDArray[np.int64] | None = None,
    progress: Progress = SILENT,
) -> tuple[VIMap, LandmarkQualityReport]:
    """Set the quality of every landmark stored in the missions to good or bad.

    Good: seen by enough vertices, from directions that differ enough, in front of every camera
    that sees it and not too near or far of the closest, with no large reprojection error.

    Args:
        vi_map: The map.
        options: The thresholds.
        missions: Mission rows; None = all.
        progress: Where to learn of cancellation.

    Raises:
        MapError: A mission's camera rig or IMU is not in sensors.yaml.
    """
    progress.check()
    rows = np.flatnonzero(landmark_mask(vi_map, missions))
    verdict = judge(vi_map, rows, options)
    quality = vi_map.landmarks.quality.copy()
    before = quality[rows]
    quality[rows] = np.where(verdict.is_good, LandmarkQuality.GOOD, LandmarkQuality.BAD)
    reasons = {f.name: int(getattr(verdict, f.name).sum()) for f in dataclasses.fields(verdict)}
    report = _report(before, quality[rows], reasons)
    return vi_map.replace(landmarks=vi_map.landmarks.replace(quality=quality)), report


def reset_quality(
    vi_map: VIMap, *, missions: NDArray[np.int64] | None = None, progress: Progress = SILENT
) -> tuple[VIMap, LandmarkQualityReport]:
    """Set the quality of every landmark stored in the missions to unknown."""
    progress.check()
    rows = np.flatnonzero(landmark_mask(vi_map, missions))
    quality = vi_map.landmarks.quality.copy()
    before = quality[rows]
    quality[rows] = LandmarkQuality.UNKNOWN
    report = _report(before, quality[rows], {})
    return vi_map.replace(landmarks=vi_map.landmarks.replace(quality=quality)), report


def judge(vi_map: VIMap, landmarks: I64, options: LandmarkQualityOptions) -> Verdict:
    """Return the reasons against landmarks (N,); observations of all missions count."""
    keypoints = vi_map.observations[ragged_rows(vi_map.observation_start, landmarks)]
    start = starts_of_counts(np.diff(vi_map.observation_start)[landmarks])
    of_landmark = np.repeat(np.arange(len(landmarks)), np.diff(start))
    p_G = vi_map.p_G[landmarks]
    seen = residuals(vi_map, keypoints, p_G[of_landmark])
    origins, _, _ = rays_in_G(vi_map, keypoints)
    directions = p_G[of_landmark] - origins
    at_camera = ~np.any(directions != 0.0, axis=1)
    directions[at_camera] = [0.0, 0.0, 1.0]

    lidar = is_lidar(vi_map, landmarks)
    observers = _distinct(vi_map.keypoint_vertex[keypoints], of_landmark, len(landmarks))
    closest = _least(seen.signed_distance_m, start, empty=np.inf)
    angle_deg = np.rad2deg(largest_ray_angle(directions, start))
    worst_px = -_least(-seen.error_px, start, empty=np.inf)
    worst_m = -_least(-np.nan_to_num(seen.error_m), start, empty=np.inf)
    o = options
    checks_px = o.max_reprojection_error_px >= 0.0
    checks_m = o.lidar_max_observation_error_m >= 0.0
    return Verdict(
        too_few_observers=observers < np.where(lidar, o.lidar_min_observers, o.min_observers),
        too_small_angle=~lidar & (angle_deg < o.min_observation_angle_deg),
        too_near_or_behind=closest
        < np.where(
            lidar,
            o.lidar_min_distance_from_closest_observer,
            o.min_distance_from_closest_observer,
        ),
        too_far=np.isfinite(closest)
        & (
            closest
            > np.where(
                lidar,
                o.lidar_max_distance_from_closest_observer,
                o.max_distance_from_closest_observer,
            )
        ),
        too_large_error=np.where(
            lidar,
            checks_m & (worst_m > o.lidar_max_observation_error_m),
            checks_px & (worst_px > o.max_reprojection_error_px),
        ),
    )


def _distinct(vertex: NDArray[np.int32], group: I64, groups: int) -> I64:
    """Count the distinct vertices (groups,) of each group."""
    width = int(vertex.max(initial=0)) + 1
    pairs = np.unique(group * width + vertex)
    return np.bincount(pairs // width, minlength=groups)


def _least(values: F64, start: I64, *, empty: float) -> F64:
    """Return the least value (L,) of each group, `empty` where there is none."""
    least = np.full(len(start) - 1, empty)
    filled = np.flatnonzero(np.diff(start) > 0)
    if len(filled):
        least[filled] = np.minimum.reduceat(values, start[:-1][filled])
    return least


def _report(
    before: NDArray[np.int8], after: NDArray[np.int8], reasons: dict[str, int]
) -> LandmarkQualityReport:
    old = np.bincount(before, minlength=3)
    new = np.bincount(after, minlength=3)
    unknown, bad, good = LandmarkQuality.UNKNOWN, LandmarkQuality.BAD, LandmarkQuality.GOOD
    return LandmarkQualityReport(
        landmarks=len(after),
        good=int(new[good]),
        bad=int(new[bad]),
        unknown=int(new[unknown]),
        good_before=int(old[good]),
        bad_before=int(old[bad]),
        unknown_before=int(old[unknown]),
        **reasons,
    )
