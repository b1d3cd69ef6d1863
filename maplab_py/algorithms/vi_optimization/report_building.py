"""Build the report of an optimisation."""

import numpy as np

from maplab_py.algorithms.vi_optimization import reports
from maplab_py.algorithms.vi_optimization.map_problem import MapProblem
from maplab_py.array_types import F64, I64
from maplab_py.distinct import distinct
from maplab_py.errors import EstimationError
from maplab_py.estimation.blocks import Manifold, ParameterBlock
from maplab_py.estimation.problem.marginals import Marginals
from maplab_py.estimation.problem.problem import Problem
from maplab_py.estimation.problem.solver import SolverSummary
from maplab_py.estimation.states import NODE_NAMES, NODES_PER_VERTEX, States
from maplab_py.estimation.terms import factor as factor_terms
from maplab_py.estimation.terms.cameras import EXTRINSICS, INTRINSICS, TIMING
from maplab_py.estimation.terms.inertial_calibration import ACCEL, GYRO, ROTATION
from maplab_py.estimation.terms.pose import MOUNTING
from maplab_py.estimation.terms.wheel import WHEEL_SCALE
from maplab_py.sensors.camera import DISTORTION_NAMES, MIRROR_NAMES
from maplab_py.vimap import VIMap, to_hex

_MATRIX = ["[0,0]", "[1,1]", "[2,2]", "[0,1]", "[0,2]", "[1,2]"]
_ROTATION = ["rotation x [rad]", "rotation y [rad]", "rotation z [rad]"]
_OF_CAMERAS = (INTRINSICS, EXTRINSICS, TIMING)
_POSE = ["x [m]", "y [m]", "z [m]", *_ROTATION]


def calibration_rows(map_problem: MapProblem, after: States) -> list[reports.CalibratedParameter]:
    """Return a row for every calibration parameter that was estimated."""
    names = [
        name
        for name in (INTRINSICS, EXTRINSICS, TIMING, GYRO, ACCEL, ROTATION, MOUNTING, WHEEL_SCALE)
        if name in after.blocks and map_problem.problem.can_move(after.nodes(name)).any()
    ]
    if not names:
        return []
    try:
        marginals: Marginals | None = Marginals(map_problem.problem, after)
    except EstimationError:
        marginals = None
    rows: list[reports.CalibratedParameter] = []
    for name in names:
        rows += _rows_of(map_problem, after, name, marginals)
    return rows


def _rows_of(
    map_problem: MapProblem, after: States, name: str, marginals: Marginals | None
) -> list[reports.CalibratedParameter]:
    block, before = after.blocks[name], map_problem.states.blocks[name]
    is_free = map_problem.problem.can_move(after.nodes(name)).reshape(len(block), -1)
    change = block.difference(before.values)
    sigma = np.full(change.shape, np.nan)
    if marginals is not None:
        if name in _OF_CAMERAS and map_problem.problem.visual is not None:
            sigma = marginals.robust_sigma(name)
        else:
            sigma = np.sqrt(np.maximum(np.diag(marginals.block(name)), 0.0)).reshape(change.shape)
    rows = []
    for row, column in np.argwhere(is_free[:, : block.dimension]):
        start = before.values[row, column] if block.manifold is Manifold.VECTOR else 0.0
        label = f"{_owner(map_problem, name, int(row))} {parameter_names(map_problem, block)[row][column]}"
        rows.append(
            reports.CalibratedParameter(
                label,
                float(start),
                float(start + change[row, column]),
                float(sigma[row, column]),
            )
        )
    return rows


def parameter_names(map_problem: MapProblem, block: ParameterBlock) -> list[list[str]]:
    """Return the names of the parameters of each row of a block."""
    if block.name in (EXTRINSICS, MOUNTING):
        return [_POSE] * len(block)
    if block.name == ROTATION:
        return [[f"R_AI {axis}" for axis in _ROTATION]] * len(block)
    if block.name in (GYRO, ACCEL):
        matrix = "T_g" if block.name == GYRO else "T_a"
        return [[matrix + place for place in _MATRIX]] * len(block)
    if block.name == WHEEL_SCALE:
        return [["scale, reported / driven distance"]] * len(block)
    if block.name == TIMING:
        return [["image delay [s]", "line delay [s]"]] * len(block)
    assert map_problem.rig is not None
    names = []
    for row in range(len(block)):
        projection, distortion = map_problem.rig.models[row]
        pinhole = ["fu [px]", "fv [px]", "cu [px]", "cv [px]"]
        names.append([*MIRROR_NAMES[projection], *pinhole, *DISTORTION_NAMES[distortion]])
    return names


def _owner(map_problem: MapProblem, name: str, row: int) -> str:
    if name in (GYRO, ACCEL, ROTATION):
        return f"IMU {map_problem.factors.imus[row].id[:8]}"
    if name == WHEEL_SCALE:
        return f"wheel sensor {map_problem.factors.wheels[row][:8]}"
    if name == MOUNTING:
        return f"sensor {map_problem.factors.mounted.owner[row][1][:8]}"
    assert map_problem.rig is not None
    _, rig_id, camera = map_problem.rig.owner[row]
    camera_id = map_problem.vi_map.sensors.camera_rig(rig_id).cameras[camera].id
    place = "on IMU " if name == EXTRINSICS else ""
    return f"camera {camera_id[:8]} {place}".rstrip()


def make_report(
    map_problem: MapProblem, after: States, summary: SolverSummary
) -> reports.VIOptimizationReport:
    """Return the report; times are filled in by the caller."""
    vi_map, selection, problem, rejection = (
        map_problem.vi_map, map_problem.selection, map_problem.problem, map_problem.rejection,
    )  # fmt: skip
    before = map_problem.states
    errors_px = (
        [] if problem.visual is None else [problem.visual.errors(s)[0] for s in (before, after)]
    )
    terms = _terms(problem, before, after, errors_px)
    errors, missions = (np.zeros((0, 2)), np.zeros(0, dtype=np.int64))
    gated = rejected = landmarks = 0
    if problem.visual is not None and rejection is not None:
        used = rejection.is_used
        errors = np.stack([error_px[used] for error_px in errors_px], axis=1)
        observing = vi_map.keypoint_vertex[selection.keypoints[used]]
        missions = vi_map.vertices.mission[observing].astype(np.int64)
        gated, rejected = rejection.gated, rejection.rejected
        landmarks = int(np.count_nonzero(rejection.used_landmarks()))
    mean, median = _mean_median(errors)
    return reports.VIOptimizationReport(
        cost_before=sum(term.cost_before for term in terms),
        cost_after=_cost(terms),
        terms=terms,
        iterations=summary.iterations,
        rejected_steps=summary.rejected_steps,
        termination=summary.termination,
        recent_decrease_percent=(
            100.0 * summary.recent_decrease / max(_cost(terms) + summary.recent_decrease, 1e-300)
        ),
        vertices=len(selection.vertices),
        vertices_held=len(map_problem.held),
        landmarks=landmarks,
        observations=len(selection.keypoints),
        observations_over_limit=selection.left_out.over_limit,
        observations_not_covisible=selection.left_out.not_covisible,
        observations_not_used=gated,
        observations_rejected=rejected,
        mean_reprojection_before_px=mean[0],
        mean_reprojection_after_px=mean[1],
        median_reprojection_before_px=median[0],
        median_reprojection_after_px=median[1],
        missions=_by_mission(vi_map, errors, missions),
        gauge=map_problem.gauge,
        linear_solver=problem.linear_solver,
        linear_iterations=problem.linear_iterations,
        singular_at=[_name_of(map_problem, after, node) for node in summary.singular_at],
        calibration=calibration_rows(map_problem, after),
        chi_square_per_freedom=_chi_square_per_freedom(map_problem, after, errors_px),
        seconds_build=0.0,
        seconds_solve=0.0,
        seconds_total=0.0,
        note=_note(landmarks, len(selection.landmarks)),
        absolute_poses_rejected=map_problem.factors.absolute_poses_rejected,
        trust_region_radius=summary.radius,
    )


def _note(used: int, landmarks: int) -> str:
    """Return a note if most landmarks become bad, else nothing."""
    if 2 * used >= landmarks:
        return ""
    return (
        f"{landmarks - used} of {landmarks} landmarks are bad: fewer than two of their observations could "
        "be used"
    )


def _cost(terms: list[reports.TermReport]) -> float:
    return sum(term.cost_after for term in terms)


def _name_of(map_problem: MapProblem, states: States, node: int) -> str:
    """Return the name of the state of the map that a node of the problem represents."""
    if node >= states.num_vertex_nodes:
        return map_problem.problem.name_of_node(states, node)
    vertex = map_problem.selection.vertices[node // NODES_PER_VERTEX]
    return (
        f"{NODE_NAMES[node % NODES_PER_VERTEX]} of {to_hex(map_problem.vi_map.vertices.id[vertex])}"
    )


def _terms(
    problem: Problem, before: States, after: States, errors_px: list[F64]
) -> list[reports.TermReport]:
    terms = []
    if problem.visual is not None:
        used = int(np.count_nonzero(problem.visual.observations.inverse_sigma))
        both = zip(errors_px, (before, after), strict=True)
        costs = [problem.visual.cost_of_errors(error_px, s) for error_px, s in both]
        terms.append(reports.TermReport("reprojection", used, *costs))
    for term in problem.factors:
        costs = [factor_terms.cost(term, states) for states in (before, after)]
        terms.append(reports.TermReport(term.name, len(term.nodes), *costs))
    return terms


def _mean_median(errors: F64) -> tuple[list[float], list[float]]:
    if not len(errors):
        return [0.0, 0.0], [0.0, 0.0]
    return errors.mean(axis=0).tolist(), np.median(errors, axis=0).tolist()


def _by_mission(vi_map: VIMap, errors: F64, missions: I64) -> list[reports.MissionReprojection]:
    rows = []
    for mission in distinct(missions).tolist():
        mission_errors = errors[missions == mission]
        mean, median = _mean_median(mission_errors)
        name = to_hex(vi_map.missions.id[mission])
        rows.append(reports.MissionReprojection(name, len(mission_errors), *mean, *median))
    return rows


def _chi_square_per_freedom(map_problem: MapProblem, states: States, errors_px: list[F64]) -> float:
    """Return the squared whitened residuals without robust loss per degree of freedom."""
    problem, total, count = map_problem.problem, 0.0, 0
    if problem.visual is not None:
        data = problem.visual.observations
        total += float(np.sum(np.square(errors_px[-1] * data.inverse_sigma)))
        count += 2 * int(np.count_nonzero(data.inverse_sigma))
    for term in problem.factors:
        residual = term.evaluate(states)[0]
        total += float(np.sum(residual**2))
        count += residual.size
    free = problem.degrees_of_freedom()
    if (
        map_problem.rejection is not None
        and problem.visual is not None
        and problem.visual.moves_points
    ):
        free += 3 * int(np.count_nonzero(map_problem.rejection.used_landmarks()))
    return total / (count - free) if count > free else float("nan")
