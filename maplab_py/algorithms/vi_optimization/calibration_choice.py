"""Calibration that the residuals contradict, which `--ba_calibration=auto` frees.

At an optimum with a fixed calibration, one Gauss-Newton step with free calibration predicts the decrease of
the cost for each group of parameters (a score test: C. R. Rao, 1948). Groups are chosen successively, by
their gain in addition to the groups already chosen, since a wrong delay also resembles a wrong rotation.
"""

import dataclasses
from typing import Any

import numpy as np

from maplab_py.algorithms.vi_optimization.map_problem import MapProblem, build, is_calibrating
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.algorithms.vi_optimization.reports import CalibratedParameter, VIOptimizationReport
from maplab_py.array_types import F64, I64, NDArray
from maplab_py.estimation.linear import protocol, threads
from maplab_py.estimation.terms.cameras import EXTRINSICS, INTRINSICS, TIMING
from maplab_py.memory import NotEnoughMemory
from maplab_py.progress import SILENT, Progress
from maplab_py.sensors.camera import MIRROR_NAMES
from maplab_py.vimap import VIMap

_LANDMARK_DAMPING = 1e-12
_CONVERGED = ("cost has converged", "no more decrease is expected", "step is small")
_MIN_OBSERVATIONS = 3000
_DIRECT = "multifrontal"
_FEW_VERTICES = 2000
"""Matrices of so many are factorised within seconds, even where every vertex sees what all others see."""
_STRONG_GAIN, _STRONG_SHARE = 3.0, 0.5
"""No true calibration gains so many times the least: it is freed from this share of the least change on."""


@dataclasses.dataclass(frozen=True)
class _Group:
    """Numbers of the calibration that are freed together."""

    flag: str
    block: str
    first: int  # column of the block
    last: int
    least_gain: float  # as a share of the cost
    least_change: float  # in units
    unit: str
    size: float  # of the unit
    words: str
    label: str  # in the names of its parameters in the report


_GROUPS = (
    _Group("fix_ncamera_time_offset", TIMING, 0, 1, 0.003, 1.0, "ms", 1e-3, "image delay", "image delay"),
    _Group("fix_ncamera_line_delay", TIMING, 1, 2, 0.005, 5.0, "us", 1e-6, "line delay", "line delay"),
    _Group(
        "fix_ncamera_extrinsics_rotation", EXTRINSICS, 3, 6, 0.01, 0.5, "deg", np.pi / 180.0,
        "rotation on the IMU", "rotation",
    ),
    _Group("fix_ncamera_intrinsics", INTRINSICS, 0, 99, 0.011, 0.6, "%", 0.01, "focal length", " fu"),
    _Group(
        "fix_ncamera_extrinsics_translation", EXTRINSICS, 0, 3, 0.02, 20.0, "mm", 1e-3,
        "position on the IMU", "on IMU",
    ),
)  # fmt: skip
"""Least gains and changes are above those of true calibrations: of MH_01 and V1_01 the rotation gains 0.4 %
by 0.25 deg, intrinsics gain 0.9 % by 0.3 % of the focal length, the position 0.4 % by 18 mm, delays 0.06 %
by 0.5 ms."""


def may_free(options: VIOptimizationOptions, report: VIOptimizationReport) -> bool:
    """Return whether calibration may be freed after an optimisation with all of it fixed.

    It must have converged, and the solver must be one that supports cameras as states.
    """
    return (
        options.calibration == "auto"
        and options.include_visual
        and options.include_inertial
        and not (options.fix_vertices or options.fix_landmark_positions or is_calibrating(options))
        and may_free_more(report)
    )


def may_free_more(report: VIOptimizationReport) -> bool:
    """Tell whether more calibration may be freed after an optimisation."""
    return can_factorise(report) and report.termination in _CONVERGED


def can_factorise(report: VIOptimizationReport) -> bool:
    """Tell whether the linear solver was the one that supports cameras as states, or can be used as well.

    Conjugate gradients are chosen where they are faster, in a short flight with two cameras, too.
    """
    return report.linear_solver == _DIRECT or report.vertices <= _FEW_VERTICES


def with_contradicted_freed(
    vi_map: VIMap,
    options: VIOptimizationOptions,
    *,
    missions: NDArray[np.integer] | None = None,
    progress: Progress = SILENT,
) -> VIOptimizationOptions:
    """Return the options with the calibration free that the residuals of an optimum contradict.

    Args:
        vi_map: The map at its optimum.
        options: Of the optimisation; what they free stays free.
    """
    flags: dict[str, Any] = {group.flag: False for group in _GROUPS}
    free = dataclasses.replace(options, **flags, linear_solver_type=_DIRECT)
    try:
        problem = build(vi_map, free, missions=missions, progress=progress)
    except NotEnoughMemory:
        progress.line("whether the residuals contradict the calibration is not known: too large")
        return options
    visual = problem.problem.visual
    if visual is None or np.count_nonzero(visual.observations.inverse_sigma) < _MIN_OBSERVATIONS:
        return options
    step = _newton_step(problem)
    if step is None:
        return options
    known = [k for k, group in enumerate(_GROUPS) if not getattr(options, group.flag)]
    chosen: dict[str, Any] = dict.fromkeys(_chosen(step, known), False)
    if len(chosen) == len(known):
        return options
    progress.line("the residuals contradict the calibration: it is freed where they do")
    return dataclasses.replace(options, **chosen)


@dataclasses.dataclass(frozen=True, eq=False)
class _Step:
    """Step of the free calibration from an optimum without it."""

    change: F64  # (k,)
    information: F64  # (k, k) of it, everything else eliminated
    group: I64  # (k,)
    units: F64  # (k,) in which a change counts; infinite = not at all
    cost: float

    def of(self, groups: list[int]) -> tuple[F64, float]:
        """Return the change (k,) with some groups free only, and the gain as a share of the cost."""
        rows = np.flatnonzero(np.isin(self.group, groups))
        change = np.zeros(len(self.change))
        if not len(rows):
            return change, 0.0
        block, side = self.information[np.ix_(rows, rows)], (self.information @ self.change)[rows]
        change[rows] = np.linalg.lstsq(block, side, rcond=None)[0]
        return change, 0.5 * float(side @ change[rows]) / self.cost


def _newton_step(map_problem: MapProblem) -> _Step | None:
    """Return the step of the free calibration; None where something is not determined."""
    problem, states = map_problem.problem, map_problem.states
    free_numbers: list[tuple[int, int, int, float]] = []  # node, direction, group, unit
    for number, group in enumerate(_GROUPS):
        of_block = states.nodes(group.block)
        free = problem.can_move(of_block).reshape(len(of_block), -1)
        free = free[:, : states.blocks[group.block].dimension]
        for row, column in np.argwhere(free):
            if group.first <= column < group.last:
                unit = group.size * _counts(map_problem, group, int(row), int(column))
                free_numbers.append((of_block[row, column // 3], column % 3, number, unit))
    table = np.array(free_numbers, dtype=np.float64).reshape(-1, 4)
    node, direction, numbers = table[:, :3].astype(np.int64).T
    with threads.single_blas_thread():
        problem.relinearize(states)
        linear = problem.linearize(states, _LANDMARK_DAMPING)
        try:
            step = problem.solve(linear, 0.0)
        except protocol.NotPositiveDefinite:
            return None
        covariance = problem.covariance_columns(node, direction)[node, direction]
    # in standard deviations, so that numbers of all sizes can be inverted together
    scale = np.sqrt(np.maximum(np.diagonal(covariance), 1e-300))
    information = np.linalg.pinv(covariance / np.outer(scale, scale), hermitian=True)
    change = step[node, direction] / scale
    return _Step(change, information, numbers, table[:, 3] / scale, linear.cost)


def _counts(map_problem: MapProblem, group: _Group, row: int, column: int) -> float:
    """Return the size of a number whose change in units counts; infinite = it does not count."""
    if group.block != INTRINSICS:
        return 1.0
    assert map_problem.rig is not None
    mirrors = len(MIRROR_NAMES[map_problem.rig.models[row][0]])
    is_focal = mirrors <= column < mirrors + 2
    return float(map_problem.states.blocks[INTRINSICS].values[row, column]) if is_focal else np.inf


def _chosen(step: _Step, known: list[int]) -> list[str]:
    """Return the flags of the groups that are chosen, after the known ones the most wanted first."""
    chosen = list(known)
    while True:
        _, reached = step.of(chosen)
        wanted: dict[int, float] = {}
        for k, group in enumerate(_GROUPS):
            if k in chosen:
                continue
            # a line delay moves the time of whole images: it is judged with their delay
            change, gain = step.of([*chosen, k, 0] if k == 1 else [*chosen, k])
            in_units = np.abs(change / step.units)[step.group == k].max(initial=0.0)
            strength = (gain - reached) / group.least_gain
            share = _STRONG_SHARE if strength >= _STRONG_GAIN else 1.0
            if strength >= 1.0 and in_units >= share * group.least_change:
                wanted[k] = gain
        best = max(wanted, key=wanted.__getitem__, default=-1)
        if best < 0:
            return [_GROUPS[k].flag for k in chosen]
        chosen += [best, 0] if best == 1 and 0 not in chosen else [best]


def freed_note(options: VIOptimizationOptions, report: VIOptimizationReport) -> str:
    """Return a line on the groups that were freed and their largest changes."""
    return (
        "the residuals contradict the calibration, so this was estimated: "
        f"{', '.join(describe_freed(options, report))} (--ba_calibration=fixed keeps it)"
    )


def describe_freed(options: VIOptimizationOptions, report: VIOptimizationReport) -> list[str]:
    """Return the largest change of every group that the options free."""
    parts: list[str] = []
    for group in _GROUPS:
        if not getattr(options, group.flag):
            parts += _describe_values(group, report.calibration)
    return parts


def _describe_values(group: _Group, rows: list[CalibratedParameter]) -> list[str]:
    """Return the largest change of a group of numbers in words."""
    of_group = [row for row in rows if group.label in row.parameter]
    if group.flag == "fix_ncamera_extrinsics_translation":
        of_group = [row for row in of_group if "rotation" not in row.parameter]
    if not of_group:
        return []
    row = max(of_group, key=lambda row: abs(row.after - row.before))
    size = group.size * (row.before if group.block == INTRINSICS else 1.0)
    change, sigma = (row.after - row.before) / size, row.sigma / size
    if not np.isfinite(sigma):
        return [f"{group.words} {change:+.1f} {group.unit} (uncertainty unknown)"]
    digits = max(0, -int(np.floor(np.log10(max(sigma, 1e-3)))))
    return [f"{group.words} {change:+.{digits}f} +- {sigma:.{digits}f} {group.unit}"]
