"""Selection of segments by information gain, the baseline of Maye et al. (Schneider 2019, reference [62]).

Every candidate is calibrated jointly with all segments selected so far. It is selected if that reduces
the entropy of the calibration by more than a threshold. The cost grows with the number of selected
segments; scores of single segments avoid this.
"""

import numpy as np

from maplab_py.algorithms.self_calibration.estimation.problem import build_segment_problem
from maplab_py.algorithms.self_calibration.estimation.solution import solve
from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.algorithms.self_calibration.segments import splitting
from maplab_py.algorithms.self_calibration.uncertainty import posterior_covariance
from maplab_py.algorithms.vi_optimization.solution import with_estimated_sensors
from maplab_py.array_types import I64, NDArray
from maplab_py.errors import UserError
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import VIMap


def select_by_gain(
    vi_map: VIMap,
    options: SelfCalibrationOptions,
    missions: NDArray[np.integer] | None = None,
    progress: Progress = SILENT,
    *,
    max_segments: int = 0,
) -> list[I64]:
    """Select segments (vertex rows) in chronological order by their information gain.

    The gain is 1/2 log(det before / det after) of the calibration's covariance. The weak priors
    restrict updates to observable directions, in place of the truncated decomposition of the
    original.

    Args:
        max_segments: Stop when this many are selected; 0 = evaluate all.

    Raises:
        UserError: No segment has enough information.
    """
    candidates = splitting.split_into_segments(vi_map, missions, options.segment_keyframes)
    selected: list[I64] = []
    sensors, before = vi_map.sensors, 0.0
    for number, rows in enumerate(candidates):
        progress.step(number, len(candidates), "calibrate with every candidate")
        joint = splitting.extract_submap(vi_map, np.unique(np.concatenate([*selected, rows])))
        problem = build_segment_problem(joint.replace(sensors=sensors), options)
        states, _ = solve(problem, options)
        scale = problem.parameters.prior_sigma
        normalised = posterior_covariance(problem, states) / np.outer(scale, scale)
        after = float(np.linalg.slogdet(normalised)[1])
        if 0.5 * (before - after) > options.min_information_gain:
            selected.append(rows)
            before, sensors = after, with_estimated_sensors(problem, states)
        if max_segments and len(selected) >= max_segments:
            break
    if not selected:
        raise UserError("no segment has enough information: lower --sc_min_information_gain")
    return selected
