"""Landmark quality: tests whether landmarks are well constrained by the geometry of their rays."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from maplab_py.algorithms.gate import Gate, any_failed
from maplab_py.algorithms.landmarks.keypoint_rays import landmark_covariance, largest_sigma
from maplab_py.algorithms.landmarks.options import LandmarkQualityOptions, LandmarkQualityReport
from maplab_py.algorithms.landmarks.sightings import is_lidar, rays_in_G, residuals
from maplab_py.array_types import F64, I64, NDArray
from maplab_py.distinct import distinct
from maplab_py.geometry.triangulation import largest_ray_angle
from maplab_py.progress import SILENT, Progress
from maplab_py.report import Report
from maplab_py.vimap import LandmarkQuality, VIMap, queries, ragged_rows, starts_of_counts, to_hex

_USUAL_SIGMA_PX = 1.0
"""Standard deviation of keypoints of which the map has none."""

_REASONS = {
    "too_few_observers": "with too few observers",
    "too_small_angle": "seen from too similar directions",
    "too_uncertain": "too uncertain",
    "too_near_or_behind": "too near to or behind a camera",
    "too_far": "too far away",
    "too_large_error": "with too large an error",
}
"""Verdicts of the criteria, counted by fields of the report, in words."""


def evaluate_quality(
    vi_map: VIMap,
    options: LandmarkQualityOptions,
    *,
    missions: NDArray[np.int64] | None = None,
    progress: Progress = SILENT,
) -> tuple[VIMap, LandmarkQualityReport]:
    """Set the quality of every landmark stored in the missions to good or bad.

    Good: seen by two vertices, from directions that differ, with a predicted standard deviation that
    is small compared with its distance, in front of every camera that sees it and not too near or far
    of the closest, with no large reprojection error.

    Raises:
        MapError: A mission's camera rig or IMU is not in sensors.yaml.
    """
    progress.check()
    rows = np.flatnonzero(queries.landmark_mask(vi_map, missions))
    judged, reasons = _judge(vi_map, rows, options)
    before, after = vi_map.landmarks.quality[rows], judged.landmarks.quality[rows]
    return judged, _report(before, after, reasons)


def _judge(
    vi_map: VIMap, rows: I64, options: LandmarkQualityOptions
) -> tuple[VIMap, dict[str, int]]:
    """Return the map with the quality of some landmarks, and how many of them fail each criterion."""
    gates = criteria(vi_map, rows, options)
    quality = np.where(any_failed(gates), LandmarkQuality.BAD, LandmarkQuality.GOOD)
    counts = {
        name: int(any_failed([gate for gate in gates if gate.verdict == name]).sum())
        for name in _REASONS
    }
    return vi_map.replace(landmarks=vi_map.landmarks.put(rows, quality=quality)), counts


def reset_quality(
    vi_map: VIMap, *, missions: NDArray[np.int64] | None = None, progress: Progress = SILENT
) -> tuple[VIMap, LandmarkQualityReport]:
    """Set the quality of every landmark stored in the missions to unknown."""
    progress.check()
    rows = np.flatnonzero(queries.landmark_mask(vi_map, missions))
    reset = vi_map.landmarks.put(rows, quality=LandmarkQuality.UNKNOWN)
    report = _report(vi_map.landmarks.quality[rows], reset.quality[rows], {})
    return vi_map.replace(landmarks=reset), report


def criteria(vi_map: VIMap, landmarks: I64, options: LandmarkQualityOptions) -> list[Gate]:
    """Return the criteria for landmarks (N,): those of camera landmarks, then those of lidar landmarks.

    Observations of all missions count.

    Raises:
        MapError: A mission's camera rig or IMU is not in sensors.yaml.
    """
    keypoints = vi_map.observations[ragged_rows(vi_map.observation_start, landmarks)]
    start = starts_of_counts(np.diff(vi_map.observation_start)[landmarks])
    of_landmark = np.repeat(np.arange(len(landmarks)), np.diff(start))
    p_G = vi_map.p_G[landmarks]
    seen = residuals(vi_map, keypoints, p_G[of_landmark])
    origins, _, _ = rays_in_G(vi_map, keypoints)
    directions = p_G[of_landmark] - origins
    at_camera = ~np.any(directions != 0.0, axis=1)
    directions[at_camera] = [0.0, 0.0, 1.0]
    angle_deg = np.rad2deg(largest_ray_angle(directions, start))
    sigma_m = _scaled_sigma(vi_map, landmarks, keypoints, seen.error_px, start)
    worst_sigma_m = np.where(np.isnan(sigma_m), np.inf, sigma_m)
    worst_px = np.maximum(-_least(-seen.error_px, start, empty=np.inf), 0.0)
    worst_m = np.maximum(-_least(-np.nan_to_num(seen.error_m), start, empty=np.inf), 0.0)
    observers = _distinct(vi_map.keypoint_vertex[keypoints], of_landmark, len(landmarks))
    closest_m = _least(seen.signed_distance_m, start, empty=np.inf)
    is_scan, o = is_lidar(vi_map, landmarks), options
    least_angle, sigma_ratio = o.min_observation_angle_deg, o.max_relative_sigma
    with np.errstate(invalid="ignore"):
        most_m = np.where(sigma_ratio < 0.0, np.inf, sigma_ratio * closest_m)
    gates = []
    for prefix, here, worst in (("", ~is_scan, worst_px), ("lidar_", is_scan, worst_m)):
        unit = "m" if prefix else "px"
        error = "lidar_max_observation_error_m" if prefix else "max_reprojection_error_px"
        near, far = (f"{prefix}{side}_distance_from_closest_observer" for side in ("min", "max"))
        limits = [getattr(o, name) for name in (f"{prefix}min_observers", near, far, error)]
        limit = limits[3] if limits[3] >= 0.0 else np.inf
        gates += [
            Gate.of("observing vertices", observers, limits[0], "too_few_observers",
                    f"--elq_{prefix}min_observers", is_minimum=True, applies=here),
            Gate.of("largest angle of two rays", angle_deg, least_angle, "too_small_angle",
                    "--elq_min_observation_angle_deg", "deg", is_minimum=True,
                    applies=here & ~is_scan),
            Gate.of("deviation along the worst axis", worst_sigma_m, most_m,
                    "too_uncertain", "--elq_max_relative_sigma", "m", applies=here & ~is_scan),
            Gate.of("distance of the closest observer", closest_m, limits[1],
                    "too_near_or_behind", f"--elq_{near}", "m", is_minimum=True, applies=here),
            Gate.of("distance of the closest observer", closest_m, limits[2], "too_far",
                    f"--elq_{far}", "m", applies=here & np.isfinite(closest_m)),
            Gate.of("largest error of an observation", worst, limit, "too_large_error",
                    f"--elq_{error}", unit, applies=here),
        ]  # fmt: skip
    return gates


def predicted_sigma(vi_map: VIMap, landmarks: I64) -> F64:
    """Return the standard deviations (N,) [m] of landmarks along their worst axes.

    The covariance by rays is multiplied by the variance of unit weight where that exceeds 1: the median
    squared reprojection error in deviations over that of Gaussian noise (chi-square with two degrees of
    freedom: 2 ln 2). The median ignores single wrong observations.

    Args:
        landmarks: Landmark rows (N,).
    """
    keypoints = vi_map.observations[ragged_rows(vi_map.observation_start, landmarks)]
    start = starts_of_counts(np.diff(vi_map.observation_start)[landmarks])
    p_G = np.repeat(vi_map.p_G[landmarks], np.diff(start), axis=0)
    return _scaled_sigma(
        vi_map, landmarks, keypoints, residuals(vi_map, keypoints, p_G).error_px, start
    )


def _scaled_sigma(vi_map: VIMap, landmarks: I64, keypoints: I64, error_px: F64, start: I64) -> F64:
    given = vi_map.keypoints.sigma_px.astype(np.float64)
    sigma_px = np.where(given > 0.0, given, _USUAL_SIGMA_PX)
    sigma_m = largest_sigma(landmark_covariance(vi_map, landmarks, sigma_px))
    squared = np.square(error_px / sigma_px[keypoints])
    variance = np.maximum(_medians(squared, start) / (2.0 * np.log(2.0)), 1.0)
    return np.asarray(sigma_m * np.sqrt(variance))


def _medians(values: F64, start: I64) -> F64:
    """Return the median (L,) of each group of values, 0 where there is none."""
    count = np.diff(start)
    owner = np.repeat(np.arange(len(count)), count)
    ordered = values[np.lexsort((values, owner))]
    medians = np.zeros(len(count))
    filled = np.flatnonzero(count)
    first, middle = start[:-1][filled], count[filled] // 2
    upper = ordered[first + middle]
    lower = ordered[first + np.maximum(count[filled] - 1, 0) // 2]
    medians[filled] = np.where(np.isinf(upper), np.inf, 0.5 * (lower + upper))
    return medians


def _distinct(vertex: NDArray[np.int32], group: I64, groups: int) -> I64:
    """Count the distinct vertices (groups,) of each group."""
    width = int(vertex.max(initial=0)) + 1
    pairs = distinct(group * width + vertex)
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
    note = mostly_bad(int(new[bad]), len(after), reasons)
    return LandmarkQualityReport(
        landmarks=len(after),
        good=int(new[good]),
        bad=int(new[bad]),
        unknown=int(new[unknown]),
        good_before=int(old[good]),
        bad_before=int(old[bad]),
        unknown_before=int(old[unknown]),
        **reasons,
        note=note,
    )


def mostly_bad(bad: int, landmarks: int, reasons: dict[str, int]) -> str:
    """Return a note if most landmarks are bad, else nothing.

    Args:
        bad: Number of bad landmarks.
        landmarks: Number of landmarks.
        reasons: Number of landmarks by name of the criterion that they fail.
    """
    if 2 * bad <= landmarks:
        return ""
    listed = ", ".join(causes_in_words(reasons))
    return f"{bad} of {landmarks} landmarks are bad" + (f": {listed}" if listed else "")


def causes_in_words(counts: Mapping[str, Any]) -> list[str]:
    """Return the criteria that bad landmarks fail, with their numbers by name, the most frequent first."""
    causes = sorted(((counts[name], name) for name in _REASONS if counts.get(name)), reverse=True)
    return [f"{count} {_REASONS[name]}" for count, name in causes]


def evaluate_unknown_quality(
    vi_map: VIMap, progress: Progress = SILENT
) -> tuple[VIMap, tuple[str, ...]]:
    """Evaluate the landmarks of unknown quality only.

    Returns:
        The map and notes for the report, empty if no quality was unknown.
    """
    unknown = vi_map.landmarks.quality == LandmarkQuality.UNKNOWN
    if not unknown.any():
        return vi_map, ()
    progress.check()
    rows = np.flatnonzero(unknown)
    judged, reasons = _judge(vi_map, rows, LandmarkQualityOptions())
    bad = int(np.count_nonzero(judged.landmarks.quality[rows] == LandmarkQuality.BAD))
    notes = (
        f"evaluated the quality of {len(rows)} landmarks first",
        mostly_bad(bad, len(rows), reasons),
    )
    return judged, tuple(text for text in notes if text)


@dataclasses.dataclass(frozen=True)
class Criterion:
    """One criterion for a landmark."""

    criterion: str
    value: str
    wanted: str
    result: str  # passed, failed or not checked
    flag: str


class LandmarkExplanation(Report):
    """The criteria of a landmark's quality."""

    landmark: str
    mission: str
    quality: str  # as stored in the map
    observations: int
    criteria: tuple[Criterion, ...]
    summary: str = dataclasses.field(metadata={"is_prose": True})


def explain_landmark(
    vi_map: VIMap, landmark: int, options: LandmarkQualityOptions
) -> LandmarkExplanation:
    """Return the criteria for a landmark (row) with the thresholds of the options.

    Raises:
        MapError: A mission's camera rig or IMU is not in sensors.yaml.
    """
    lines = tuple(
        Criterion(gate.name, *gate.describe(0), gate.flag)
        for gate in criteria(vi_map, np.array([landmark]), options)
        if gate.applies[0]
    )
    failed = [line.criterion for line in lines if line.result == "failed"]
    verdict = "bad: it fails " + ", ".join(failed) if failed else "good"
    return LandmarkExplanation(
        to_hex(vi_map.landmarks.id[landmark]),
        to_hex(vi_map.missions.id[vi_map.vertices.mission[vi_map.landmarks.vertex[landmark]]])[:8],
        LandmarkQuality(int(vi_map.landmarks.quality[landmark])).name.lower(),
        int(np.diff(vi_map.observation_start)[landmark]),
        lines,
        f"With these thresholds the landmark is {verdict}.",
    )
