"""The least-squares problem of segments (thesis section 5.4), and of whole missions alike."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.algorithms.self_calibration.parameters import Parameters, parameters_of
from maplab_py.algorithms.self_calibration.segments import (
    gap_walks,
    parallax_rad,
    partitions,
    pieces,
    split_by_partition,
)
from maplab_py.algorithms.vi_optimization.building import PosedProblem, build
from maplab_py.algorithms.vi_optimization.gauge import hold_unconstrained
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.errors import EstimationError
from maplab_py.estimation.blocks import ParameterBlocks
from maplab_py.estimation.camera_terms import EXTRINSICS
from maplab_py.estimation.factor_terms import FactorTerm
from maplab_py.estimation.gauge import first_of_each, fix_position_and_heading
from maplab_py.estimation.imu.inertial_data import InertialData
from maplab_py.estimation.inertial_terms import BiasWalkTerm
from maplab_py.estimation.loss import Loss
from maplab_py.estimation.prior_terms import VertexVectorPrior
from maplab_py.estimation.problem import Problem
from maplab_py.estimation.states import ACCEL_BIAS, GYRO_BIAS, VELOCITY, States
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import VIMap
from maplab_py.vimap.selection import keep_rows

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


class CalibrationPrior:
    """The calibration is near its nominal value; one weak factor over all its parameters."""

    name = "calibration prior"
    loss = (Loss.NONE, 1.0)

    def __init__(self, parameters: Parameters, states: States, middle: ParameterBlocks) -> None:
        """Tie the parameters of states of this layout to the values of some blocks."""
        self._parameters, self._reference = parameters, middle
        node, direction = parameters.nodes(states)
        unique, where = np.unique(node, return_inverse=True)
        self.nodes = unique[None, :]
        self._weight = 1.0 / parameters.prior_sigma
        self._jacobian = np.zeros((1, len(parameters), 3 * len(unique)))
        column = 3 * np.asarray(where).reshape(-1) + direction
        self._jacobian[0, np.arange(len(parameters)), column] = self._weight

    def evaluate(self, states: States) -> tuple[F64, F64]:
        """Return whitened residuals (1, k) and Jacobians (1, k, 3 n); rotations to first order."""
        change = self._parameters.difference(states.blocks, self._reference)
        return (change * self._weight)[None, :], self._jacobian


class GapWalkTerm(BiasWalkTerm):
    """The walk of the biases across what was removed between segments of a mission."""

    name = "bias walk across gaps"


@dataclasses.dataclass(frozen=True, eq=False)
class SegmentProblem:
    """A posed problem, its calibration parameters and how it falls apart."""

    posed: PosedProblem
    parameters: Parameters
    partition: I64  # (V,) label of every vertex
    runs: int  # pieces without a gap in time
    gaps: int  # bridged by the walk of the biases

    @property
    def num_partitions(self) -> int:
        """Number of partitions."""
        return int(self.partition.max(initial=-1)) + 1


def pose(
    vi_map: VIMap,
    options: SelfCalibrationOptions,
    *,
    missions: NDArray[np.integer] | None = None,
    robust: bool = True,
    prior_at: ParameterBlocks | None = None,
    progress: Progress = SILENT,
) -> SegmentProblem:
    """Pose the problem of all segments in a map, or of whole missions (rows, None = all).

    Args:
        vi_map: Segments, or a whole map.
        options: What to estimate.
        missions: Which missions take part.
        robust: With the loss of the options and rejection of outliers; otherwise every
            measurement counts in full, for information rather than estimates.
        prior_at: Where the calibration prior has its middle; None = the map's calibration.
        progress: Shown while kernels are compiled.

    Raises:
        EstimationError: Nothing can be estimated.
        MapError: Calibrations are missing.
    """
    label = partitions(vi_map, options.min_shared_landmarks)
    vi_map = split_by_partition(vi_map, label)
    wide = parallax_rad(vi_map) >= np.deg2rad(options.min_parallax_deg)
    vi_map = keep_rows(vi_map, landmarks=np.flatnonzero(wide))
    posed = build(vi_map, vi_options(options, robust), missions=missions, progress=progress)
    imus = posed.factors.imus
    parameters = parameters_of(posed.rig, len(imus), posed.states, options)
    if not len(parameters):
        raise EstimationError("nothing to calibrate: neither tracks nor inertial edges")
    first, second, gap_s = gap_walks(vi_map)
    prior = CalibrationPrior(parameters, posed.states, prior_at or posed.states.blocks)
    terms = [prior, *_weak_priors(posed, vi_map, options)]
    problem = _with_more_terms(posed, terms, vi_map, first, second, gap_s)
    held = _fix(problem, posed, parameters, label)
    posed = dataclasses.replace(posed, problem=problem, held=held, gauge="one keyframe a partition")
    runs = len(np.unique(pieces(vi_map)))
    return SegmentProblem(posed, parameters, label, runs, len(first))


def vi_options(options: SelfCalibrationOptions, robust: bool = True) -> VIOptimizationOptions:
    """Return the options of the underlying problem."""
    wanted = options.estimated()
    return VIOptimizationOptions(
        num_iterations=options.num_iterations,
        function_tolerance=options.function_tolerance,
        fix_ncamera_intrinsics=False,
        fix_ncamera_extrinsics_rotation=False,
        fix_ncamera_extrinsics_translation=False,
        fix_ncamera_time_offset="time_offset" not in wanted,
        fix_imu_intrinsics="imu" not in wanted,
        loss=options.loss if robust else "none",
        retriangulate_doubtful=robust,
        gate_reprojection_error_px=options.gate_reprojection_error_px,
        trust_region_schedule="step_quality",
    )


def _weak_priors(
    posed: PosedProblem, vi_map: VIMap, options: SelfCalibrationOptions
) -> list[FactorTerm]:
    """Keep biases and velocities determined where nothing moves, at the begin of every run."""
    states = posed.states
    beginnings = posed.selection.rows(first_of_each(pieces(vi_map)))
    beginnings = beginnings[beginnings >= 0]
    return [
        VertexVectorPrior(kind, beginnings, values[beginnings], sigma)
        for kind, values, sigma in (
            (GYRO_BIAS, states.gyro_bias, options.prior_gyro_bias_radps),
            (ACCEL_BIAS, states.accel_bias, options.prior_accel_bias_mps2),
            (VELOCITY, states.v_G, options.prior_velocity_mps),
        )
    ]


def _with_more_terms(
    posed: PosedProblem,
    more: list[FactorTerm],
    vi_map: VIMap,
    before: I64,
    after: I64,
    gap_s: F64,
) -> Problem:
    """Add terms and the walk of the biases across gaps."""
    states, rows = posed.states, posed.selection.rows
    terms: list[FactorTerm] = [*posed.problem.factors, *more]
    inside = (rows(before) >= 0) & (rows(after) >= 0)
    if inside.any():
        density = _walk_density(vi_map, before[inside])
        variance = density * gap_s[inside, None]
        terms.append(
            GapWalkTerm(rows(before[inside]), rows(after[inside]), variance[:, 0], variance[:, 1])
        )
    return Problem(states, posed.problem.visual, terms)


def _walk_density(vi_map: VIMap, vertices: I64) -> F64:
    """Return squared densities (G, 2) of the walks of the biases of the vertices' missions."""
    data = InertialData.of_map(vi_map)
    of_mission = np.zeros((len(vi_map.missions), 2))
    edge_mission = vi_map.vertices.mission[vi_map.imu_edges.from_vertex]
    of_mission[edge_mission] = data.walk_variance_density[data.imu_of_edge]
    return np.asarray(of_mission[vi_map.vertices.mission[vertices]])


def _fix(problem: Problem, posed: PosedProblem, parameters: Parameters, label: I64) -> I64:
    """Fix what is not estimated, and position and heading of one keyframe of every partition."""
    states = posed.states
    held = hold_unconstrained(problem, states)
    is_free = np.zeros((problem.num_nodes, 3), dtype=np.bool_)
    is_free[parameters.nodes(states)] = True
    nodes = np.arange(states.num_vertex_nodes, problem.num_nodes)
    problem.restrict(nodes, is_free[nodes][:, :, None] * np.eye(3))
    own = label[posed.selection.vertices]
    fix_position_and_heading(problem, states, first_of_each(own))
    if EXTRINSICS not in states.blocks and not problem.factors:
        raise EstimationError("nothing to calibrate: no camera has usable tracks")
    return held
