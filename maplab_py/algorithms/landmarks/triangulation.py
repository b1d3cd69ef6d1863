"""Triangulate landmarks again from the rays of their observations."""

import numpy as np

from maplab_py.algorithms.landmarks.options import LandmarkQualityOptions, RetriangulationReport
from maplab_py.algorithms.landmarks.quality import evaluate_quality
from maplab_py.algorithms.landmarks.sightings import is_lidar, rays_in_G, residuals
from maplab_py.array_types import F64, I64, Mask, NDArray
from maplab_py.geometry import triangulation
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import VIMap, edits, queries, ragged_rows, starts_of_counts


def retriangulate(
    vi_map: VIMap,
    options: LandmarkQualityOptions,
    *,
    missions: NDArray[np.int64] | None = None,
    progress: Progress = SILENT,
) -> tuple[VIMap, RetriangulationReport]:
    """Triangulate every landmark stored in the missions, then evaluate its quality.

    The position of a landmark is unchanged if it has fewer than two observations, if its rays are
    parallel, or if the new point is behind one of its cameras; quality evaluation then marks it as
    bad. Store vertices do not change, nor do landmarks of 3-D (lidar) observations.

    Raises:
        MapError: A mission's camera rig or IMU is not in sensors.yaml.
    """
    progress.step(0, 2, "triangulate landmarks")
    chosen = np.flatnonzero(queries.landmark_mask(vi_map, missions))
    rows = chosen[~is_lidar(vi_map, chosen)]
    keypoints = vi_map.observations[ragged_rows(vi_map.observation_start, rows)]
    start = starts_of_counts(np.diff(vi_map.observation_start)[rows])
    p_G, determined, in_front = triangulate_keypoints(vi_map, keypoints, start)
    placed = determined & in_front
    enough = np.diff(start) >= 2
    with np.errstate(over="ignore"):  # from beyond 1e154 m
        shift = np.linalg.norm(p_G[placed] - vi_map.p_G[rows[placed]], axis=1)
    progress.step(1, 2, "judge landmarks")
    moved = edits.with_p_G(vi_map, rows[placed], p_G[placed])
    judged, quality = evaluate_quality(moved, options, missions=missions, progress=progress)
    report = RetriangulationReport(
        landmarks=len(chosen),
        triangulated=int(placed.sum()),
        too_few_observations=int((~enough).sum()),
        undetermined=int((enough & ~determined).sum()),
        behind_camera=int((determined & ~in_front).sum()),
        median_shift_m=float(np.median(shift)) if len(shift) else 0.0,
        quality=quality,
    )
    return judged, report


def triangulate_keypoints(vi_map: VIMap, keypoints: I64, start: I64) -> tuple[F64, Mask, Mask]:
    """Triangulate groups of keypoints.

    Args:
        keypoints: Keypoint rows (O,), grouped.
        start: Offsets (L + 1) of the groups.

    Returns:
        Points in G (L, 3), whether they are determined (L,), and whether they lie in front of all
        cameras of their group (L,). Keypoints without a ray do not take part.
    """
    origins, directions, valid = rays_in_G(vi_map, keypoints)
    group = np.repeat(np.arange(len(start) - 1), np.diff(start))
    used = starts_of_counts(np.bincount(group[valid], minlength=len(start) - 1))
    p_G, determined, _ = triangulation.triangulate(origins[valid], directions[valid], used)
    distance = residuals(vi_map, keypoints, p_G[group]).signed_distance_m
    behind = np.bincount(group[(distance <= 0.0) & valid], minlength=len(start) - 1) > 0
    return p_G, determined, determined & ~behind
