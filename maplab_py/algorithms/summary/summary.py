"""Create a summary map: good landmarks in G, their projected descriptors and observers."""

import dataclasses
from pathlib import Path

import numpy as np

from maplab_py.algorithms.landmarks import evidence, persistence, quality
from maplab_py.algorithms.localization.database import features_of_good_landmarks
from maplab_py.algorithms.loop_closure.features import MapFeatures, map_features
from maplab_py.algorithms.summary.options import SummaryMapContent, SummaryMapOptions
from maplab_py.array_types import F32, F64, I64, U8
from maplab_py.errors import EstimationError
from maplab_py.geometry import se3, so3, symmetric
from maplab_py.progress import SILENT, Progress
from maplab_py.sensors import CameraRig
from maplab_py.storage.summary_map import SummaryMap
from maplab_py.vimap import FeatureType, VIMap, type_name
from maplab_py.vision.projection import DescriptorProjection

_FLAT_DIRECTION_SIGMA_M = 10.0
"""Standard deviation of the prior of a landmark along unobserved directions."""
_CURVE_STEP_M, _CURVE_BITS = 0.5, 20
"""Cells of the curve along which landmarks are ordered, and how many there may be along an axis."""


def make_summary_map(
    vi_map: VIMap,
    options: SummaryMapOptions,
    *,
    projection: DescriptorProjection | None = None,
    feature_type: int = FeatureType.BINARY,
    sizes: tuple[int, ...] = (),
    progress: Progress = SILENT,
) -> SummaryMap:
    """Reduce a map to its good landmarks in G.

    The quality of landmarks is evaluated first where it is unknown.

    Args:
        vi_map: The map; its base frames must be known.
        projection: Projection of the descriptors; by default learned from the map's tracks.
        feature_type: Type of the descriptors.
        sizes: Lengths [bytes] that they may have; empty = any.

    Raises:
        EstimationError: No good landmark has descriptors of the type, or too few tracks to learn from.
    """
    judged, _ = quality.evaluate_unknown_quality(vi_map, progress)
    progress.step(0, 3, "project descriptors")
    missions = np.arange(len(judged.missions))
    features, projection = map_features(
        judged,
        missions,
        projection=projection,
        dimensions=None,
        feature_type=feature_type,
        sizes=sizes,
    )
    rows = features_of_good_landmarks(judged, features)
    if len(rows) == 0:
        raise EstimationError(
            f"no good landmark has {type_name(feature_type)} descriptors: run rtl",
            remedy="retriangulate_landmarks",
        )
    progress.step(1, 3, "select observations")
    rows = rows[np.argsort(features.descriptors.label[rows], kind="stable")]
    if options.max_observations_per_landmark:
        rows = _spread(rows, features, options.max_observations_per_landmark)
    landmarks, landmark = np.unique(features.descriptors.label[rows], return_inverse=True)
    order = _along_a_curve(judged.p_G[landmarks])
    place = np.empty(len(order), dtype=np.int64)
    place[order] = np.arange(len(order))
    landmarks, landmark = landmarks[order], place[landmark.reshape(-1)]
    by_landmark = np.argsort(landmark, kind="stable")
    rows, landmark = rows[by_landmark], landmark[by_landmark]
    vertices, observer = np.unique(features.vertex[rows], return_inverse=True)
    progress.step(2, 3, "landmarks")
    covariance = None
    if options.covariances:
        covariance = landmark_covariances(judged, features)[landmarks].astype(np.float32)
    summary = SummaryMap(
        p_G=judged.p_G[landmarks].astype(np.float32),
        p_G_observer=judged.T_G_I[vertices, 4:].astype(np.float32),
        descriptors=np.ascontiguousarray(features.descriptors.projected[rows], dtype=np.float32),
        landmark=landmark.astype(np.uint32),
        observer=observer.reshape(-1).astype(np.uint32),
        landmark_id=judged.landmarks.id[landmarks] if options.landmark_ids else None,
        observer_id=judged.vertices.id[vertices],
        landmark_covariance=covariance,
        projection=projection.matrix,
        sensors=judged.sensors,
        descriptor_kind=None if features.kind.is_binary else features.kind,
        existence_percent=_existence_percent(judged, landmarks),
    )
    return rounded(summary, options, features.kind.projected.coarseness)


def _existence_percent(vi_map: VIMap, landmarks: I64) -> U8 | None:
    """Return the probability (N,) that landmarks (rows) exist; None without evidence."""
    if not evidence.has_evidence(vi_map):
        return None
    now = float(evidence.session_times_s(vi_map).max())
    exists = persistence.existence(
        evidence.read_evidence(vi_map), persistence.PersistenceOptions(), at_s=now
    )
    return np.round(100.0 * exists[landmarks]).astype(np.uint8)


def rounded(summary: SummaryMap, options: SummaryMapOptions, coarseness: float = 1.0) -> SummaryMap:
    """Round positions and descriptors as set in the options, so that the file compresses better."""
    return dataclasses.replace(
        summary,
        p_G=_to_multiples(summary.p_G, options.position_step_m),
        p_G_observer=_to_multiples(summary.p_G_observer, options.position_step_m),
        descriptors=_to_multiples(summary.descriptors, coarseness * options.descriptor_step),
    )


def _to_multiples(values: F32, step: float) -> F32:
    """Round to multiples of a step; 0 = leave as it is."""
    if not step:
        return values
    return np.asarray(np.round(values / np.float32(step)) * np.float32(step), dtype=np.float32)


def _along_a_curve(p_G: F64) -> I64:
    """Return an order of points (N, 3) in which neighbours in space follow each other.

    The curve is Morton's (bits of the coordinates interleaved). Leading bytes of the positions then
    repeat and the file compresses better. Readers do not depend on the order.
    """
    cell = np.floor((p_G - p_G.min(axis=0)) / _CURVE_STEP_M).astype(np.int64)
    cell = np.minimum(cell, (1 << _CURVE_BITS) - 1)
    key = np.zeros(len(p_G), dtype=np.int64)
    for bit in range(_CURVE_BITS):
        for axis in range(3):
            key |= ((cell[:, axis] >> bit) & 1) << (3 * bit + axis)
    return np.argsort(key, kind="stable")


def landmark_covariances(vi_map: VIMap, features: MapFeatures) -> F64:
    """Return the covariance (L, 3, 3) [m^2] of landmarks in G given the poses of their observers.

    A ray with direction d, depth z and angular sigma adds the information (I - d d^T) / (z sigma)^2.
    A weak prior bounds the variance of unobserved directions.
    """
    mine = np.flatnonzero(features.descriptors.label >= 0)
    landmark, vertex = features.descriptors.label[mine], features.vertex[mine]
    T_G_I = vi_map.T_G_I[vertex]
    offset = vi_map.p_G[landmark] - se3.transform(T_G_I, features.origin_I[mine])
    ray = so3.rotate(T_G_I[:, :4], features.ray_I[mine])
    depth = np.linalg.norm(offset, axis=1)
    sigma_rad = vi_map.keypoints.sigma_px[features.keypoint[mine]] * features.rad_per_px[mine]
    weight = 1.0 / np.maximum(depth * sigma_rad, 1e-6) ** 2
    across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
    information = np.zeros((len(vi_map.landmarks), 3, 3))
    for i in range(3):
        for j in range(3):
            information[:, i, j] = np.bincount(
                landmark, weight * across[:, i, j], minlength=len(information)
            )
    least = 1.0 / _FLAT_DIRECTION_SIGMA_M**2
    return symmetric.inverse(information + least * np.eye(3), least)


def _spread(rows: I64, features: MapFeatures, most: int) -> I64:
    """Keep a maximum number of observations of each landmark, spread evenly over its observers.

    Args:
        rows: Feature rows sorted by landmark.
        most: Maximum number of observations per landmark.
    """
    label = features.descriptors.label[rows]
    _, first, count = np.unique(label, return_index=True, return_counts=True)
    rank = np.arange(len(rows)) - np.repeat(first, count)
    total = np.repeat(count, count)
    # keep where the rank enters a new one of `most` equal parts
    part = rank * most // total
    before = (rank - 1) * most // total
    return np.asarray(rows[(total <= most) | (rank == 0) | (part != before)])


def describe(summary: SummaryMap, file: Path) -> SummaryMapContent:
    """Describe a summary map that was read from a file."""
    sigma = None
    if summary.landmark_covariance is not None and len(summary.p_G):
        variance = np.trace(summary.landmark_covariance, axis1=1, axis2=2)
        sigma = float(np.sqrt(np.median(variance)))
    percent = summary.existence_percent
    extent = np.ptp(summary.p_G_observer, axis=0) if len(summary.p_G_observer) else np.zeros(3)
    sensors = summary.sensors.sensors.values() if summary.sensors is not None else ()
    return SummaryMapContent(
        landmarks=len(summary.p_G),
        observations=len(summary.descriptors),
        observers=len(summary.p_G_observer),
        descriptor_dimensions=summary.descriptors.shape[1],
        has_ids=summary.landmark_id is not None,
        has_projection=summary.projection is not None,
        cameras=sum(len(rig.cameras) for rig in sensors if isinstance(rig, CameraRig)),
        median_position_sigma_m=sigma,
        mean_existence=round(float(percent.mean()) / 100.0, 3)
        if percent is not None and len(percent)
        else None,
        extent_m=(float(extent[0]), float(extent[1]), float(extent[2])),
        megabytes=file.stat().st_size * 1e-6,
    )
