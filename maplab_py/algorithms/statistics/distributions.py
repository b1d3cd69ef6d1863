"""Distributions of the quantities of a map."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import ArrayLike

from maplab_py.geometry.triangulation import largest_ray_angle
from maplab_py.report import Report
from maplab_py.vimap import VIMap
from maplab_py.vimap.queries import observation_counts, observer_counts


@dataclasses.dataclass(frozen=True)
class QuantityLine:
    """Order statistics of one quantity."""

    quantity: str
    count: int
    least: float
    median: float
    mean: float
    percentile_95: float
    largest: float


@dataclasses.dataclass(frozen=True)
class MapDistributions(Report):
    """Order statistics of the quantities that distinguish good maps from bad ones."""

    quantities: tuple[QuantityLine, ...]


def map_distributions(vi_map: VIMap) -> MapDistributions:
    """Return the distributions of the quantities that the map has."""
    v = vi_map.vertices
    inside = v.mission[1:] == v.mission[:-1]
    step_m = np.linalg.norm(np.diff(v.T_M_I[:, 4:], axis=0), axis=1)[inside]
    step_s = (np.diff(v.timestamp_ns) * 1e-9)[inside]
    seeing = vi_map.keypoint_frame[vi_map.keypoints.landmark >= 0]
    landmarks_per_frame = np.bincount(seeing, minlength=len(vi_map.frames))
    tracks = vi_map.keypoints.track_id
    rows = vi_map.observations
    landmark = vi_map.keypoints.landmark[rows]
    offset = vi_map.p_G[landmark] - vi_map.T_G_I[vi_map.keypoint_vertex[rows], 4:]
    distance = np.linalg.norm(offset, axis=1)
    seen = np.diff(vi_map.observation_start) >= 2
    rays = np.where(distance[:, None] > 1e-9, offset, np.array([0.0, 0.0, 1.0]))
    angle = np.degrees(largest_ray_angle(rays, vi_map.observation_start))[seen]
    sampled = vi_map.imu_samples.timestamp_ns
    edge_of_sample = np.repeat(np.arange(len(vi_map.imu_edges)), vi_map.imu_edges.sample_count)
    spacing_s = (np.diff(sampled) * 1e-9)[edge_of_sample[1:] == edge_of_sample[:-1]]
    speed = np.linalg.norm(v.v_M, axis=1)
    by_mission = np.bincount(v.mission, minlength=len(vi_map.missions))
    quantities: dict[str, ArrayLike] = {
        "vertices per mission": by_mission,
        "distance of vertices [m]": step_m,
        "time between vertices [s]": step_s,
        "speed [m/s]": speed,
        "keypoints per image": vi_map.frames.keypoint_count,
        "landmarks per image": landmarks_per_frame,
        "keypoints per track": _track_lengths(vi_map) if (tracks >= 0).any() else [],
        "observations per landmark": observation_counts(vi_map),
        "observing vertices per landmark": observer_counts(vi_map),
        "distance of observed landmarks [m]": distance,
        "angle between rays of a landmark [deg]": angle,
        "IMU sample spacing [s]": spacing_s,
        "IMU samples per edge": vi_map.imu_edges.sample_count,
    }
    lines = [_line(name, values) for name, values in quantities.items()]
    return MapDistributions(tuple(line for line in lines if line is not None))


def _track_lengths(vi_map: VIMap) -> ArrayLike:
    """Return the number of keypoints of every track of a camera of a mission."""
    rows = np.flatnonzero(vi_map.keypoints.track_id >= 0)
    frame = vi_map.keypoint_frame[rows]
    mission = vi_map.vertices.mission[vi_map.frames.vertex[frame]]
    camera = vi_map.frames.camera_index[frame]
    order = np.lexsort((vi_map.keypoints.track_id[rows], camera, mission))
    keys = np.stack([mission, camera, vi_map.keypoints.track_id[rows]])[:, order]
    first = np.flatnonzero(np.any(np.diff(keys, prepend=-1), axis=0))
    return np.diff(np.append(first, len(rows)))


def _line(name: str, values: ArrayLike) -> QuantityLine | None:
    numbers = np.asarray(values, dtype=np.float64)
    if len(numbers) == 0:
        return None
    return QuantityLine(
        name,
        len(numbers),
        float(numbers.min()),
        float(np.median(numbers)),
        float(numbers.mean()),
        float(np.percentile(numbers, 95.0)),
        float(numbers.max()),
    )
