"""Segments of fixed length against borders where the information per time changes."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import numpy as np

from maplab_py.algorithms.self_calibration.changes import joint_covariance
from maplab_py.algorithms.self_calibration.segments.selection import Evaluation, evaluate
from maplab_py.algorithms.self_calibration.segments.splitting import extract_submap
from maplab_py.array_types import F64, I64
from maplab_py.simulation.scenario import Scenario
from maplab_py.vimap import VIMap
from studies.data_sets import OPTIONS, append_line, data_set
from studies.published import levels, relative_rms
from studies.selections import FEW

_PIECE = 11
"""Keyframes of a piece of one second; its borders are candidates."""
_SHORTEST, _LONGEST = 2, 8
"""Pieces of an adaptive segment."""
_CHANGE = 1.0
"""Change of the logarithm of a piece's information at which a segment ends, in medians of such changes."""


def compare(scenario: Scenario, sets: range, out: Path) -> None:
    """Append a line per session: predicted deviations (thesis = 1) of 32 s of fixed and adaptive segments."""
    measurement = dataclasses.replace(scenario.measurement, max_keypoints=80)
    scenario, better = dataclasses.replace(scenario, measurement=measurement), 0
    for number in sets:
        vi_map = data_set(scenario, number).maps[0]
        fixed = evaluate(vi_map, OPTIONS)
        unit, prior = levels(fixed.parameters.names), fixed.parameters.prior_sigma
        best = np.argsort([_trace(s.covariance, unit) for s in fixed.segments])[:FEW]
        kept = [fixed.segments[row] for row in best]
        budget_s = sum(_duration_s(vi_map, segment.rows) for segment in kept)
        taken = _adaptive(vi_map, unit, budget_s)
        size = [
            relative_rms(np.sqrt(np.diag(joint_covariance(c, prior))).tolist(), fixed.parameters.names)
            for c in ([segment.covariance for segment in kept], taken)
        ]  # fmt: skip
        better += size[1] < size[0]
        append_line(out, {"set": number, "scenario": scenario.name, "fixed": size[0],
                          "adaptive": size[1], "segments": len(taken)})  # fmt: skip
        sys.stdout.write(
            f"{scenario.name} {number}: fixed {size[0]:.2f}, adaptive {size[1]:.2f} ({len(taken)} segments)\n"
        )
        sys.stdout.flush()
    sys.stdout.write(f"adaptive borders better in {better} of {len(sets)}\n")


def _duration_s(vi_map: VIMap, rows: I64) -> float:
    time_ns = vi_map.vertices.timestamp_ns
    return 1e-9 * float(time_ns[rows[-1]] - time_ns[rows[0]])


def _trace(covariance: F64, unit: F64) -> float:
    return float(np.sum(np.diag(covariance) / unit**2))


def _adaptive(vi_map: VIMap, unit: F64, budget_s: float) -> list[F64]:
    """Return covariances of the segments with most information per time, of so much time in all."""
    pieces = evaluate(vi_map, dataclasses.replace(OPTIONS, segment_keyframes=_PIECE))
    candidates = []
    for rows in _merged(pieces, unit):
        alone = extract_submap(vi_map, rows)
        options = dataclasses.replace(OPTIONS, segment_keyframes=len(rows))
        covariance = evaluate(alone, options).segments[0].covariance
        if len(covariance) != len(unit):
            continue  # without information about the IMU
        duration_s = _duration_s(vi_map, rows)
        candidates.append((_trace(covariance, unit) * duration_s, duration_s, covariance))
    taken: list[F64] = []
    for _, duration_s, covariance in sorted(candidates, key=lambda each: each[0]):
        if duration_s <= budget_s + 0.05:
            taken.append(covariance)
            budget_s -= duration_s
    return taken


def _merged(pieces: Evaluation, unit: F64) -> list[I64]:
    """Return segments (vertex rows): pieces are merged until their information changes."""
    size = np.array([-np.log(_trace(piece.covariance, unit)) for piece in pieces.segments])
    limit = _CHANGE * float(np.median(np.abs(np.diff(size))))
    result, first = [], 0
    for number in range(1, len(size) + 1):
        is_long = number - first >= _LONGEST or number == len(size)
        if not is_long and abs(size[number] - size[first:number].mean()) <= limit:
            continue
        if number - first >= _SHORTEST or is_long:
            rows = np.unique(np.concatenate([p.rows for p in pieces.segments[first:number]]))
            result.append(rows)
            first = number
    return result
