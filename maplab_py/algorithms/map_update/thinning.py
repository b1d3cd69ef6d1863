"""Budgets of a map: the landmarks and vertices that stay when new sessions have come."""

import dataclasses
from typing import Any

import numpy as np

from maplab_py.algorithms.landmarks.evidence import read_evidence
from maplab_py.algorithms.landmarks.persistence import PersistenceOptions, existence
from maplab_py.algorithms.map_update.options import UpdateOptions
from maplab_py.algorithms.sparsification import selection
from maplab_py.algorithms.sparsification.options import SparsificationOptions
from maplab_py.algorithms.sparsification.sparsify import sparsify
from maplab_py.algorithms.statistics.statistics import bytes_by_kind
from maplab_py.array_types import F64, I64, Mask, NDArray, mask_of
from maplab_py.distinct import distinct
from maplab_py.errors import UserError
from maplab_py.geometry import se3
from maplab_py.progress import SILENT, Progress
from maplab_py.report import counted
from maplab_py.sensors import Extrinsics, OtherSensor, SensorSet
from maplab_py.vimap import (
    MissionSensor,
    TransformationEdges,
    TransformationKind,
    VIMap,
    edits,
    from_hex,
    mission_sensor_id,
    random_ids,
    tables,
    to_hex,
    vertex_removal,
)

_MIN_MISSES = 2
"""Sessions that missed a landmark before it counts as vanished, however unlikely it is."""
_ROUNDS, _MARGIN = 6, 0.97
"""Rounds in which both budgets shrink until the map is small enough, and the margin of each."""
_LARGEST_STEP, _LEAST_SLOPE = 0.1, 0.1
"""Bounds of a round: the smallest share of the last budgets, and of the size that falls with them."""
_DRIFT, _SIGMA_M, _SIGMA_RAD = 0.01, 0.01, 0.005
"""Standard deviation of odometry edges between keyframes that stay: of their length, and at least."""


@dataclasses.dataclass(frozen=True)
class Thinned:
    """Numbers of removed entities."""

    landmarks_vanished: int
    landmarks_thinned: int
    vertices: int
    missions: int
    missions_without_imu: int


def size_mb(vi_map: VIMap) -> float:
    """Return the size of a map in memory [MB]."""
    return sum(size for _, size in bytes_by_kind(vi_map).values()) * 1e-6


def thin(
    vi_map: VIMap,
    new: Mask,
    options: UpdateOptions,
    persistence: PersistenceOptions,
    progress: Progress = SILENT,
) -> tuple[VIMap, Thinned]:
    """Remove landmarks that no longer exist, and those and vertices beyond the budget.

    Args:
        new: Missions (M,) whose vertices keep their inertial measurements.

    Raises:
        UserError: The size cannot be met.
    """
    vanished = vanished_landmarks(vi_map, options, persistence)
    before = len(vi_map.landmarks)
    vi_map = edits.remove_landmarks(vi_map, vanished)
    start, ids = vi_map, vi_map.missions.id[new]
    landmarks = options.max_landmarks or len(vi_map.landmarks)
    vertices = options.max_vertices or len(vi_map.vertices)
    share, last = 1.0, (0.0, 0.0)  # of both budgets; that of the last round with its size
    for _ in range(_ROUNDS):
        most = max(int(share * landmarks), 1), max(int(share * vertices), 1)
        vi_map, without_imu = _within(start, ids, *most, options, persistence, progress)
        size = size_mb(vi_map)
        if options.max_map_mb == 0.0 or size <= options.max_map_mb:
            break
        if share == 1.0:
            landmarks, vertices = len(vi_map.landmarks), len(vi_map.vertices)
        # sensors and new inertial measurements stay: the size is a line through the last two
        slope = max((last[1] - size) / (last[0] - share), _LEAST_SLOPE * size / share)
        last = share, size
        excess = (size - _MARGIN * options.max_map_mb) / slope
        share = float(np.clip(share - excess, _LARGEST_STEP * share, _MARGIN * share))
    else:
        raise UserError(
            f"--max_map_mb={options.max_map_mb:g} cannot be met: the map has {size:.3g} MB with "
            f"{counted(len(vi_map.vertices), 'vertex', 'vertices')} and "
            f"{counted(len(vi_map.landmarks), 'landmark')}"
        )
    return vi_map, Thinned(
        landmarks_vanished=int(vanished.sum()),
        landmarks_thinned=before - int(vanished.sum()) - len(vi_map.landmarks),
        vertices=len(start.vertices) - len(vi_map.vertices),
        missions=len(start.missions) - len(vi_map.missions),
        missions_without_imu=without_imu,
    )


def vanished_landmarks(
    vi_map: VIMap, options: UpdateOptions, persistence: PersistenceOptions
) -> Mask:
    """Return the landmarks (L,) that hardly exist and were missed by several sessions."""
    evidence = read_evidence(vi_map)
    recent = evidence["recent"]
    missed = (recent["time_s"] > 0) & (recent["matched"] == 0)
    misses = evidence["misses"] + missed.sum(axis=1)
    exists = existence(evidence, persistence)
    return np.asarray((exists < options.vanished_below) & (misses >= _MIN_MISSES))


def _within(
    vi_map: VIMap,
    new_missions: NDArray[np.uint64],
    landmarks: int,
    vertices: int,
    options: UpdateOptions,
    persistence: PersistenceOptions,
    progress: Progress,
) -> tuple[VIMap, int]:
    """Return the map with at most so many landmarks and vertices, and the missions without IMU."""
    if len(vi_map.landmarks) > landmarks:
        vi_map, _, _ = sparsify(
            vi_map, landmarks, SparsificationOptions(), persistence, progress=progress
        )
    if len(vi_map.vertices) <= vertices:
        return vi_map, 0
    kept = choose_vertices(vi_map, vertices, options.observers_kept)
    mission = vi_map.vertices.mission
    emptied = np.bincount(mission[kept], minlength=len(vi_map.missions)) == 0
    ids = vi_map.vertices.id[kept]
    vi_map = edits.remove_missions(vi_map, emptied)
    removed = np.ones(len(vi_map.vertices), dtype=np.bool_)
    removed[vi_map.vertex_index.rows(ids)] = False
    is_new = vi_map.mission_index.rows(new_missions)
    old = np.setdiff1d(vi_map.vertices.mission[removed], is_new)
    vi_map = with_odometry_instead_of_imu(vertex_removal.remove_vertices(vi_map, removed), old)
    vi_map = edits.remove_keypoints(vi_map, vi_map.keypoints.landmark < 0)
    return edits.remove_landmarks(vi_map, np.diff(vi_map.observation_start) == 0), len(old)


def choose_vertices(vi_map: VIMap, keep: int, min_observers: int) -> Mask:
    """Return the vertices (V,) that stay: together they cover all landmarks, the newer ones first.

    It is the problem of sparsification with exchanged roles: landmarks should keep their observers.
    """
    keypoints = vi_map.observations
    vertex = vi_map.keypoint_vertex[keypoints].astype(np.int64)
    count = max(len(vi_map.landmarks), 1)
    pairs = distinct(vertex * count + vi_map.keypoints.landmark[keypoints])
    landmark = pairs % count
    observers = np.bincount(landmark, minlength=count).astype(np.float64)
    _, age = np.unique(vi_map.vertices.timestamp_ns, return_inverse=True)
    problem = selection.CoverageProblem(
        keyframe=landmark,
        landmark=pairs // count,
        score=np.asarray(age.reshape(-1) / max(int(age.max(initial=0)), 1), dtype=np.float64),
        weight=np.ones(len(vi_map.vertices)),
        wanted=np.minimum(observers, min_observers),
        base=np.zeros(count),
        level_value=selection.level_values(min_observers),
        full=float(min_observers),
        keep=min(keep, len(vi_map.vertices)),
    )
    return selection.choose_greedily(problem)


def with_odometry_instead_of_imu(vi_map: VIMap, missions: I64) -> VIMap:
    """Return the map in which the poses of some missions (rows) are joined by odometry edges only.

    Inertial measurements over the long gaps of a thinned mission weigh much and tell little.
    """
    missions = missions[vi_map.missions.backbone[missions] == tables.Backbone.VIWLS]
    if len(missions) == 0:
        return vi_map
    is_old = mask_of(len(vi_map.missions), missions)
    mission = vi_map.vertices.mission
    first = np.flatnonzero((mission[1:] == mission[:-1]) & is_old[mission[:-1]])
    sensors, of_mission = _odometry_sensors(vi_map, missions)
    edges = _odometry_edges(vi_map, first, of_mission[mission[first]])
    dropped = is_old[mission[vi_map.imu_edges.from_vertex]]
    samples = np.repeat(~dropped, vi_map.imu_edges.sample_count)
    sensor_id = vi_map.missions.sensor_id.copy()
    sensor_id[missions, MissionSensor.ODOMETRY_6DOF] = of_mission[missions]
    backbone = np.where(is_old, tables.Backbone.ODOMETRY, vi_map.missions.backbone)
    return vi_map.replace(
        sensors=sensors,
        missions=vi_map.missions.replace(backbone=backbone, sensor_id=sensor_id),
        imu_edges=tables.ImuEdges.concatenate([vi_map.imu_edges.take(~dropped)]),
        imu_samples=tables.ImuSamples.concatenate([vi_map.imu_samples.take(samples)]),
        transformation_edges=TransformationEdges.concatenate([vi_map.transformation_edges, edges]),
    )


def _odometry_sensors(vi_map: VIMap, missions: I64) -> tuple[SensorSet, NDArray[Any]]:
    """Return the sensors with an odometry sensor in every IMU, and its id (M, 2) by mission."""
    sensors, extrinsics = dict(vi_map.sensors.sensors), dict(vi_map.sensors.extrinsics)
    ids = np.zeros((len(vi_map.missions), 2), dtype=np.uint64)
    for mission in missions.tolist():
        imu = mission_sensor_id(vi_map, mission, MissionSensor.IMU)
        words = from_hex(imu) ^ np.array([0, 0x0D0], dtype=np.uint64)
        name = to_hex(words)
        keys = {"id": name, "sensor_type": "ODOMETRY_6DOF", "topic": "odometry_6dof"}
        sensors[name] = OtherSensor(name, "ODOMETRY_6DOF", keys)
        extrinsics[name] = Extrinsics(imu, se3.identity())
        ids[mission] = words
    return SensorSet(sensors, extrinsics, vi_map.sensors.extra), ids


def _odometry_edges(vi_map: VIMap, first: I64, sensor_id: NDArray[Any]) -> TransformationEdges:
    """Return edges from vertices (E,) to the next ones, as their poses are."""
    T_A_B = se3.relative(vi_map.vertices.T_M_I[first], vi_map.vertices.T_M_I[first + 1])
    sigma_m = _SIGMA_M + _DRIFT * np.linalg.norm(T_A_B[:, 4:], axis=1)
    diagonal = np.repeat(np.stack([sigma_m, np.full(len(first), _SIGMA_RAD)], axis=1), 3, axis=1)
    covariance: F64 = np.square(diagonal)[:, :, None] * np.eye(6)
    return TransformationEdges.filled(
        len(first),
        id=random_ids(len(first), edits.content_rng(vi_map, "odometry edges")),
        kind=np.full(len(first), TransformationKind.ODOMETRY),
        from_vertex=first,
        to_vertex=first + 1,
        T_A_B=T_A_B,
        covariance=covariance,
        sensor_id=sensor_id,
    )
