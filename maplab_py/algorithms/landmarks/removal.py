"""Remove bad landmarks, and observations that contradict their landmark."""

import numpy as np

from maplab_py.algorithms.landmarks import sightings, tracks, triangulation
from maplab_py.algorithms.landmarks.options import (
    InvalidObservationOptions,
    InvalidObservationReport,
    LandmarkRemovalReport,
)
from maplab_py.array_types import I64, Mask, NDArray
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import LandmarkQuality, VIMap, edits, queries


def remove_bad(
    vi_map: VIMap, *, missions: NDArray[np.int64] | None = None, progress: Progress = SILENT
) -> tuple[VIMap, LandmarkRemovalReport]:
    """Remove every landmark of quality bad that is stored in the missions (None = all)."""
    progress.check()
    chosen = queries.landmark_mask(vi_map, missions)
    bad = chosen & (vi_map.landmarks.quality == LandmarkQuality.BAD)
    result = edits.remove_landmarks(vi_map, bad)
    unknown = vi_map.landmarks.quality == LandmarkQuality.UNKNOWN
    report = LandmarkRemovalReport(
        landmarks_removed=int(bad.sum()),
        observations_removed=int(queries.observation_counts(vi_map)[bad].sum()),
        landmarks_left=int((chosen & ~bad).sum()),
        unknown_left=int((chosen & unknown).sum()),
    )
    return result, report


def remove_invalid_observations(
    vi_map: VIMap,
    options: InvalidObservationOptions,
    *,
    missions: NDArray[np.int64] | None = None,
    progress: Progress = SILENT,
) -> tuple[VIMap, InvalidObservationReport]:
    """Detach invalid observations and create new landmarks from their tracks.

    Observations are invalid if they repeat a landmark in a frame (the one with the smallest
    reprojection error stays), lie behind the camera, or have a reprojection error above the limit.
    Detached keypoints of one landmark and one feature track become a new landmark of unknown
    quality if they can be triangulated and agree.

    Args:
        missions: Rows of the missions that store the landmarks; None = all.

    Raises:
        MapError: A mission's camera rig or IMU is not in sensors.yaml.
    """
    progress.check()
    chosen = queries.landmark_mask(vi_map, missions)
    keypoints = vi_map.observations[chosen[vi_map.keypoints.landmark[vi_map.observations]]]
    landmark = vi_map.keypoints.landmark[keypoints]
    seen = sightings.residuals(vi_map, keypoints, vi_map.p_G[landmark])
    twice, behind, far = _reasons(vi_map, keypoints, seen, options.max_reprojection_error_px)
    removed = twice | behind | far
    progress.check()
    result = edits.remove_observations(vi_map, keypoints[removed])
    added, reattached = 0, 0
    if options.make_new_landmarks:
        result, added, reattached = _from_detached(
            result, keypoints[removed], landmark[removed].astype(np.int64), options
        )
    had = np.diff(vi_map.observation_start) > 0
    lost = had & (queries.observation_counts(result)[: len(had)] == 0)
    report = InvalidObservationReport(
        observations=len(keypoints),
        twice_in_frame=int(twice.sum()),
        behind_camera=int((behind & ~twice).sum()),
        too_large_error=int((far & ~behind & ~twice).sum()),
        landmarks_added=added,
        observations_reattached=reattached,
        landmarks_without_observations=int(lost.sum()),
    )
    return result, report


def _reasons(
    vi_map: VIMap, keypoints: I64, seen: sightings.Residuals, max_error_px: float
) -> tuple[Mask, Mask, Mask]:
    """Return which observations (O,) are repeated in a frame, behind the camera, or outliers."""
    landmark, frame = vi_map.keypoints.landmark[keypoints], vi_map.keypoint_frame[keypoints]
    order = np.lexsort((keypoints, seen.error_px, frame, landmark))
    again = np.zeros(len(keypoints), dtype=np.bool_)
    again[1:] = (landmark[order[1:]] == landmark[order[:-1]]) & (
        frame[order[1:]] == frame[order[:-1]]
    )
    twice = np.zeros(len(keypoints), dtype=np.bool_)
    twice[order] = again
    visual = ~sightings.is_lidar(vi_map, landmark)
    behind = visual & (seen.signed_distance_m <= 0.0)
    return twice, behind, visual & (seen.error_px > max_error_px)


def _from_detached(
    vi_map: VIMap, keypoints: I64, landmark: I64, options: InvalidObservationOptions
) -> tuple[VIMap, int, int]:
    """Make landmarks from detached keypoints (N,) of one former landmark (N,) and track."""
    tracked = vi_map.keypoints.track_id[keypoints] >= 0
    rows, start = tracks.group_tracks(vi_map, keypoints[tracked], landmark[tracked])
    if len(start) == 1:
        return vi_map, 0, 0
    p_G, _, usable = triangulation.triangulate_keypoints(vi_map, rows, start)
    group = np.repeat(np.arange(len(start) - 1), np.diff(start))
    error = sightings.residuals(vi_map, rows, p_G[group]).error_px
    worst = np.maximum.reduceat(error, start[:-1])
    usable &= worst <= options.max_reprojection_error_px
    result, observations = tracks.add_tracks(vi_map, rows, start, p_G, usable)
    return result, int(usable.sum()), observations
