"""The least-squares problem of segments, or of whole missions (Schneider 2019, section 5.4)."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.self_calibration.estimation.parameters import Parameters, parameters_of
from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.algorithms.vi_optimization.fixed_states import hold_unconstrained
from maplab_py.algorithms.vi_optimization.map_problem import MapProblem, MapTerms, collect_terms
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.array_types import F64, I64
from maplab_py.errors import EstimationError
from maplab_py.estimation.blocks import ParameterBlocks
from maplab_py.estimation.imu.inertial_data import InertialData
from maplab_py.estimation.loss import Loss
from maplab_py.estimation.problem.gauge import clusters, first_of_each, fix_position_and_heading
from maplab_py.estimation.problem.problem import Problem
from maplab_py.estimation.states import ACCEL_BIAS, GYRO_BIAS, VELOCITY, States
from maplab_py.estimation.terms import cameras, inertial, prior, protocol
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import VIMap, edits, observer_counts, random_ids, selection, tables
from maplab_py.vimap.vertex_removal import move_landmarks


class CalibrationPrior(protocol.FixedMeasurements):
    """A weak prior on the calibration: one factor over all its parameters."""

    name = "calibration prior"
    loss = (Loss.NONE, 1.0)

    def __init__(self, parameters: Parameters, states: States, mean: ParameterBlocks) -> None:
        """Tie the parameters of states of this layout to the values of some blocks."""
        self._parameters, self._mean = parameters, mean
        node, direction = parameters.nodes(states)
        unique, where = np.unique(node, return_inverse=True)
        self.nodes = unique[None, :]
        self._weight = 1.0 / parameters.prior_sigma
        self._jacobian = np.zeros((1, len(parameters), 3 * len(unique)))
        column = 3 * np.asarray(where).reshape(-1) + direction
        self._jacobian[0, np.arange(len(parameters)), column] = self._weight

    def evaluate(self, states: States) -> tuple[F64, F64]:
        """Return whitened residuals (1, k) and Jacobians (1, k, 3 n); rotations to first order."""
        change = self._parameters.difference(states.blocks, self._mean)
        return (change * self._weight)[None, :], self._jacobian


class GapWalkTerm(inertial.BiasWalkTerm):
    """Random walk of the biases across the gaps between the segments of a mission."""

    name = "bias walk across gaps"


@dataclasses.dataclass(frozen=True, eq=False)
class SegmentProblem(MapProblem):
    """The problem of a map with its calibration parameters and partitions."""

    parameters: Parameters
    partition: I64  # (V,) label of every vertex of the map
    gaps: int  # bridged by the random walk of the biases

    @property
    def num_partitions(self) -> int:
        """Number of partitions."""
        return int(self.partition.max(initial=-1)) + 1


def build_segment_problem(
    vi_map: VIMap,
    options: SelfCalibrationOptions,
    *,
    missions: NDArray[np.integer] | None = None,
    robust: bool = True,
    prior_mean: ParameterBlocks | None = None,
    progress: Progress = SILENT,
) -> SegmentProblem:
    """Build the problem of all segments of a map, or of whole missions (rows, None = all).

    Args:
        vi_map: Segments, or a whole map.
        missions: Which missions to use.
        robust: Use the loss of the options and reject outliers. Otherwise every measurement has its
            full weight, for information instead of estimates.
        prior_mean: Mean of the calibration prior; None = the map's calibration.

    Raises:
        EstimationError: There is nothing to estimate.
        MapError: Calibrations are missing.
    """
    partition = partitions(vi_map, options.min_shared_landmarks)
    vi_map = split_landmarks(vi_map, partition)
    has_parallax = parallax_rad(vi_map) >= np.deg2rad(options.min_parallax_deg)
    vi_map = selection.keep_rows(vi_map, landmarks=np.flatnonzero(has_parallax))
    parts = collect_terms(vi_map, vi_options(options, robust), missions=missions, progress=progress)
    states = parts.states
    parameters = parameters_of(parts.rig, len(parts.factors.imus), states, options)
    if not len(parameters):
        raise EstimationError("nothing to calibrate: neither tracks nor inertial edges")
    gaps = bias_gaps(vi_map)
    terms = [
        *parts.terms,
        CalibrationPrior(parameters, states, prior_mean or states.blocks),
        *_motion_priors(parts, options),
        *_gap_walks(parts, gaps),
    ]
    problem = Problem(states, parts.visual, terms)
    held = _fix_gauge(problem, parts, parameters, partition)
    map_problem = parts.map_problem(problem, held, "one keyframe a partition")
    return SegmentProblem(
        **vars(map_problem), parameters=parameters, partition=partition, gaps=len(gaps.before)
    )


def vi_options(options: SelfCalibrationOptions, robust: bool = True) -> VIOptimizationOptions:
    """Return the options with which the terms of the problem are built."""
    names = options.estimated()
    return VIOptimizationOptions(
        fix_ncamera_intrinsics=False,
        fix_ncamera_extrinsics_rotation=False,
        fix_ncamera_extrinsics_translation=False,
        fix_ncamera_time_offset="time_offset" not in names,
        fix_ncamera_line_delay="line_delay" not in names,
        fix_imu_intrinsics="imu" not in names,
        loss=options.loss if robust else "none",
        retriangulate_doubtful=robust,
        gate_reprojection_error_px=options.gate_reprojection_error_px,
    )


def _motion_priors(parts: MapTerms, options: SelfCalibrationOptions) -> list[protocol.FactorTerm]:
    """Return weak priors on biases and velocity of the first vertex of every run.

    They keep these determined where nothing moves.
    """
    states = parts.states
    first = parts.selection.rows(first_of_each(runs_of(parts.vi_map)))
    first = first[first >= 0]
    return [
        prior.VertexVectorPrior(kind, first, values[first], sigma)
        for kind, values, sigma in (
            (GYRO_BIAS, states.gyro_bias, options.prior_gyro_bias_radps),
            (ACCEL_BIAS, states.accel_bias, options.prior_accel_bias_mps2),
            (VELOCITY, states.v_G, options.prior_velocity_mps),
        )
    ]


def _gap_walks(parts: MapTerms, gaps: BiasGaps) -> list[protocol.FactorTerm]:
    """Return the random walk of the biases across gaps, if there are any."""
    before, after = parts.selection.rows(gaps.before), parts.selection.rows(gaps.after)
    inside = (before >= 0) & (after >= 0)
    if not inside.any():
        return []
    density = _walk_density(parts.vi_map, gaps.before[inside])
    variance = density * gaps.duration_s[inside, None]
    return [GapWalkTerm(before[inside], after[inside], variance[:, 0], variance[:, 1])]


def _walk_density(vi_map: VIMap, vertices: I64) -> F64:
    """Return the variance densities (G, 2) of the bias walks of the vertices' missions."""
    data = InertialData.of_map(vi_map)
    of_mission = np.zeros((len(vi_map.missions), 2))
    edge_mission = vi_map.vertices.mission[vi_map.imu_edges.from_vertex]
    of_mission[edge_mission] = data.walk_variance_density[data.imu_of_edge]
    return np.asarray(of_mission[vi_map.vertices.mission[vertices]])


def _fix_gauge(problem: Problem, parts: MapTerms, parameters: Parameters, partition: I64) -> I64:
    """Fix what is not estimated, and position and heading of one keyframe of every partition."""
    states = parts.states
    held = hold_unconstrained(problem, states)
    is_free = np.zeros((problem.num_nodes, 3), dtype=np.bool_)
    is_free[parameters.nodes(states)] = True
    nodes = np.arange(states.num_vertex_nodes, problem.num_nodes)
    problem.restrict(nodes, is_free[nodes][:, :, None] * np.eye(3))
    first = first_of_each(partition[parts.selection.vertices])
    fix_position_and_heading(problem, states, first)
    if cameras.EXTRINSICS not in states.blocks and not problem.factors:
        raise EstimationError("nothing to calibrate: no camera has usable tracks")
    return held


_MAX_DISTANCE_M = 10.0
"""Parallax is computed as if no landmark were farther away."""
_USUAL_QUANTILE = 0.9
"""Parallax is computed as if no landmark were nearer than this quantile of all distances. Landmarks
with little parallax, or seen from poses that have drifted, are estimated too near, and would seem to
have parallax."""


def runs_of(vi_map: VIMap) -> I64:
    """Label the vertices (V,) by runs that inertial edges join, in row order."""
    edges = vi_map.imu_edges
    links = [(edges.from_vertex.astype(np.int64), edges.to_vertex.astype(np.int64))]
    return clusters(len(vi_map.vertices), links)


def partitions(vi_map: VIMap, min_shared_landmarks: int) -> I64:
    """Label the vertices (V,) by partitions, numbered in row order (Schneider 2019, algorithm 4).

    Vertices that inertial edges join belong together, and so do runs that share more landmarks than
    the given number; landmarks of joined runs count together.
    """
    run_of_vertex = runs_of(vi_map)
    count = int(run_of_vertex.max(initial=-1)) + 1
    joined: list[tuple[set[int], set[int]]] = []  # runs and landmarks of each partition
    run_of_observation = run_of_vertex[vi_map.keypoint_vertex[vi_map.observations]]
    landmark = vi_map.keypoints.landmark[vi_map.observations]
    for run in range(count):
        seen = set(landmark[run_of_observation == run].tolist())
        shares = [len(other & seen) > min_shared_landmarks for _, other in joined]
        merged = [group for group, yes in zip(joined, shares, strict=True) if yes]
        joined = [group for group, yes in zip(joined, shares, strict=True) if not yes]
        runs = {run}.union(*(others for others, _ in merged))
        joined.append((runs, seen.union(*(others for _, others in merged))))
    partition_of_run = np.zeros(count, dtype=np.int64)
    for number, (runs, _) in enumerate(sorted(joined, key=lambda group: min(group[0]))):
        partition_of_run[list(runs)] = number
    return np.asarray(partition_of_run[run_of_vertex])


def split_landmarks(vi_map: VIMap, partition: I64) -> VIMap:
    """Give every partition (V,) its own copy of the landmarks that it shares with others.

    Partitions have separate gauges, which a shared landmark would tie together. Copies that fewer
    than two vertices observe are dropped.
    """
    rows = vi_map.observations
    landmark = vi_map.keypoints.landmark[rows].astype(np.int64)
    count = max(int(partition.max(initial=-1)) + 1, 1)
    keys, copy = np.unique(
        landmark * count + partition[vi_map.keypoint_vertex[rows]], return_inverse=True
    )
    copy = np.asarray(copy).reshape(-1)
    if len(keys) == len(vi_map.landmarks):
        return vi_map
    first_vertex = np.zeros(len(keys), dtype=np.int64)
    first_vertex[copy[::-1]] = vi_map.keypoint_vertex[rows][::-1]
    source = keys // count
    table = vi_map.landmarks.take(source)
    new_landmark = np.full(len(vi_map.keypoints), tables.NO_ROW, dtype=np.int32)
    new_landmark[rows] = copy
    is_copy = np.flatnonzero(np.concatenate([[False], source[1:] == source[:-1]]))
    ids = table.id.copy()
    ids[is_copy] = random_ids(len(is_copy), edits.content_rng(vi_map, "partitions"))
    copied = vi_map.replace(
        landmarks=table.replace(id=ids),
        keypoints=vi_map.keypoints.replace(landmark=new_landmark),
    )
    moved = np.flatnonzero(partition[vi_map.landmarks.vertex[source]] != keys % count)
    copied = move_landmarks(copied, moved, first_vertex[moved])
    return selection.keep_rows(copied, landmarks=np.flatnonzero(observer_counts(copied) >= 2))


def parallax_rad(vi_map: VIMap) -> F64:
    """Return the angle (L,) by which the camera moved as seen from each landmark.

    It is the motion across the line of sight over the landmark's distance, which is clamped: from
    below by a quantile of all distances, from above by `_MAX_DISTANCE_M`. Distances of landmarks
    without parallax are noise, and mostly too small (decision 18).
    """
    rows = vi_map.observations
    landmark = vi_map.keypoints.landmark[rows]
    centre = vi_map.T_G_I[vi_map.keypoint_vertex[rows], 4:]
    count = np.maximum(np.diff(vi_map.observation_start), 1)
    sums = [np.bincount(landmark, c, minlength=len(count)) for c in centre.T]
    mean = np.stack(sums, axis=1) / count[:, None]
    sight = vi_map.p_G - mean
    distance = np.linalg.norm(sight, axis=1)
    sight /= np.maximum(distance, 1e-9)[:, None]
    offset = centre - mean[landmark]
    along = np.einsum("oi,oi->o", offset, sight[landmark])
    across = np.linalg.norm(offset - along[:, None] * sight[landmark], axis=1)
    widest = np.zeros(len(count))
    np.maximum.at(widest, landmark, across)
    usual = _MAX_DISTANCE_M
    if len(distance):
        usual = min(float(np.quantile(distance, _USUAL_QUANTILE)), _MAX_DISTANCE_M)
    return np.asarray(2.0 * widest / np.clip(distance, max(usual, 0.1), _MAX_DISTANCE_M))


@dataclasses.dataclass(frozen=True, eq=False)
class BiasGaps:
    """Gaps between the segments of a mission, across which the biases walk at random."""

    before: I64  # (G,) vertex rows
    after: I64  # (G,) vertex rows
    duration_s: F64  # (G,)


def bias_gaps(vi_map: VIMap) -> BiasGaps:
    """Return the gaps within missions; there are none between missions.

    An IMU that was switched off has new biases.
    """
    run, mission = runs_of(vi_map), vi_map.vertices.mission
    before = np.flatnonzero((run[1:] != run[:-1]) & (mission[1:] == mission[:-1]))
    time_ns = vi_map.vertices.timestamp_ns
    duration_s = np.asarray((time_ns[before + 1] - time_ns[before]) * 1e-9)
    return BiasGaps(before, before + 1, duration_s)
