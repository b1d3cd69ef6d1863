"""Selection by information gain, the baseline of Maye et al. (thesis [62]).

Every candidate is calibrated jointly with all segments kept so far; it is kept when that makes the
calibration more certain by more than a threshold. Costs grow with what is kept, which is what the
scores of single segments avoid.
"""

from __future__ import annotations

import dataclasses
import time

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.self_calibration.calibration import solve
from maplab_py.algorithms.self_calibration.information import posterior_covariance
from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.algorithms.self_calibration.problem import pose
from maplab_py.algorithms.self_calibration.segments import cut, restricted
from maplab_py.algorithms.vi_optimization.writing_back import with_estimated_sensors
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import VIMap

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


@dataclasses.dataclass(frozen=True, eq=False)
class GainSelection:
    """Kept segments (vertex rows), in the order in which they came, and what it took."""

    kept: tuple[I64, ...]
    gains: tuple[float, ...]  # nat, of every candidate
    seconds: float


def select_by_gain(
    vi_map: VIMap,
    options: SelfCalibrationOptions,
    *,
    missions: NDArray[np.integer] | None = None,
    max_segments: int = 0,
    progress: Progress = SILENT,
) -> GainSelection:
    """Go through the segments in time and keep those that tell something new.

    The gain is 1/2 log(det before / det after) of the calibration's covariance. Updates are
    restricted to observable directions by the weak priors, which stand for the truncated
    decomposition of the original.

    Args:
        vi_map: The map.
        options: What to estimate, and the threshold.
        missions: Missions (rows, None = all).
        max_segments: Stop when this many are kept; 0 = go through all.
        progress: Shown per candidate.
    """
    began = time.perf_counter()
    candidates = cut(vi_map, missions, options.segment_keyframes)
    kept: list[I64] = []
    gains = []
    sensors, before = vi_map.sensors, np.nan
    for number, rows in enumerate(candidates):
        progress.step(number, len(candidates), "calibrate with every candidate")
        joint = restricted(vi_map, np.unique(np.concatenate([*kept, rows])))
        problem = pose(joint.replace(sensors=sensors), options)
        states, _ = solve(problem, options, SILENT)
        covariance = posterior_covariance(problem, states)
        scale = problem.parameters.prior_sigma
        after = float(np.linalg.slogdet(covariance / np.outer(scale, scale))[1])
        gain = 0.5 * ((0.0 if np.isnan(before) else before) - after)
        gains.append(gain)
        if gain > options.min_information_gain:
            kept.append(rows)
            before, sensors = after, with_estimated_sensors(problem.posed, states)
        if max_segments and len(kept) >= max_segments:
            break
    return GainSelection(tuple(kept), tuple(gains), time.perf_counter() - began)
