"""Why a landmark is good or bad: the criteria of `quality.judge` with values and thresholds."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.algorithms.landmarks.options import LandmarkQualityOptions
from maplab_py.algorithms.landmarks.sightings import is_lidar, rays_in_G, residuals
from maplab_py.geometry.triangulation import largest_ray_angle
from maplab_py.report import Report
from maplab_py.vimap import LandmarkQuality, VIMap
from maplab_py.vimap.ids import to_hex


@dataclasses.dataclass(frozen=True)
class Criterion:
    """One criterion for a landmark."""

    criterion: str
    value: str
    wanted: str
    result: str  # passed, failed or not checked
    flag: str


@dataclasses.dataclass(frozen=True)
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
    start = vi_map.observation_start
    keypoints = vi_map.observations[start[landmark] : start[landmark + 1]]
    p_G = vi_map.p_G[[landmark]]
    seen = residuals(vi_map, keypoints, np.repeat(p_G, len(keypoints), axis=0))
    origins, _, _ = rays_in_G(vi_map, keypoints)
    ends = np.array([0, len(keypoints)], dtype=np.int64)
    angle_deg = float(np.rad2deg(largest_ray_angle(p_G - origins, ends))[0])
    observers = len(np.unique(vi_map.keypoint_vertex[keypoints]))
    closest = float(seen.signed_distance_m.min(initial=np.inf))
    is_scan = bool(is_lidar(vi_map, np.array([landmark]))[0])
    prefix = "lidar_" if is_scan else ""
    criteria = [
        _minimum("observing vertices", observers, options, f"{prefix}min_observers", ""),
    ]
    if not is_scan:
        criteria.append(
            _minimum(
                "largest angle of two rays", angle_deg, options, "min_observation_angle_deg", "deg"
            )
        )
    name = f"{prefix}min_distance_from_closest_observer"
    criteria.append(_minimum("distance of the closest observer", closest, options, name, "m"))
    name = f"{prefix}max_distance_from_closest_observer"
    criteria.append(_maximum("distance of the closest observer", closest, options, name, "m"))
    if is_scan:
        worst = float(np.nan_to_num(seen.error_m).max(initial=0.0))
        name, unit = "lidar_max_observation_error_m", "m"
    else:
        worst, name, unit = float(seen.error_px.max(initial=0.0)), "max_reprojection_error_px", "px"
    criteria.append(_maximum("largest error of an observation", worst, options, name, unit))
    failed = [c for c in criteria if c.result == "failed"]
    verdict = "bad: it fails " + ", ".join(c.criterion for c in failed) if failed else "good"
    return LandmarkExplanation(
        to_hex(vi_map.landmarks.id[landmark]),
        to_hex(vi_map.missions.id[vi_map.vertices.mission[vi_map.landmarks.vertex[landmark]]])[:8],
        LandmarkQuality(int(vi_map.landmarks.quality[landmark])).name.lower(),
        len(keypoints),
        tuple(criteria),
        f"With these thresholds the landmark is {verdict}.",
    )


def _minimum(
    criterion: str, value: float, options: LandmarkQualityOptions, field: str, unit: str
) -> Criterion:
    limit = float(getattr(options, field))
    return _line(criterion, value, f"at least {limit:g}", value < limit, field, unit)


def _maximum(
    criterion: str, value: float, options: LandmarkQualityOptions, field: str, unit: str
) -> Criterion:
    limit = float(getattr(options, field))
    if limit < 0.0:  # not checked
        line = _line(criterion, value, "any", False, field, unit)
        return dataclasses.replace(line, result="not checked", wanted="any")
    is_beyond = np.isfinite(value) and value > limit
    return _line(criterion, value, f"at most {limit:g}", bool(is_beyond), field, unit)


def _line(
    criterion: str, value: float, wanted: str, failed: bool, field: str, unit: str
) -> Criterion:
    text = f" {unit}" if unit else ""
    return Criterion(
        criterion,
        f"{value:.4g}{text}",
        f"{wanted}{text}",
        "failed" if failed else "passed",
        f"--elq_{field}",
    )
