"""Counterparts of figures 6.5, 6.8, 6.9, 7.8, 7.9, 7.10 and 7.11 of Schneider 2019, in one picture."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.algorithms.self_calibration.calibration import calibrate
from maplab_py.algorithms.self_calibration.segments import selection, splitting
from maplab_py.array_types import F64, I64
from maplab_py.errors import EstimationError
from maplab_py.geometry import so3
from maplab_py.simulation.scenario import Scenario
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.vimap import VIMap
from studies.accuracy import DataSet
from studies.data_sets import OPTIONS, data_set
from studies.joint_ekf import filter_jointly
from studies.published import levels, relative_rms
from studies.selections import FEW, WHOLE, rankings

_COUNTS = (1, 2, 4, 6, 8, 12, 16)
_MISALIGNMENT = "gyroscope xy misalignment"
Figure = Any


def draw(scenario: Scenario, sets: range, out: Path, walk: Scenario | None = None) -> None:
    """Measure, and write the picture; the walk of figure 7.10 is that of `navigation` unless given."""
    import matplotlib.pyplot as plt

    data = [DataSet.of(scenario, number) for number in sets]
    batch = [_error(each, each.vi_map) for each in data]
    figure, axes = plt.subplots(3, 3, figsize=(13.0, 10.0))
    _entropies(axes[0, 0], data)
    _updates(axes[0, 1], data[0], batch[0])
    _most_and_least(axes[0, 2], axes[2, 1], data, batch)
    _sessions(axes[1, 0], data)
    _filter(axes[1, 1], data[0])
    _in_time(axes[1, 2], axes[2, 0], walk or load_scenario("navigation"))
    axes[2, 2].axis("off")
    figure.tight_layout()
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out)
    plt.close(figure)


def _error(data: DataSet, vi_map: VIMap) -> F64:
    """Return the error (k,) of a calibration on a map; parameters that it lacks stay as they were."""
    error = data.nominal_error.copy()
    try:
        result, _ = calibrate(vi_map, OPTIONS)
    except EstimationError:
        return error
    rows = [data.names.index(name) for name in result.parameters.names]
    error[rows] = result.parameters.difference(result.blocks, data.truth)
    return error


def _on(data: DataSet, rows: list[I64]) -> F64:
    return _error(data, splitting.extract_submap(data.vi_map, np.unique(np.concatenate(rows))))


def _size(data: DataSet, error: F64) -> float:
    return relative_rms(error.tolist(), data.names)


def _title(axes: Figure, number: str, title: str, x: str, y: str) -> None:
    axes.set_title(f"{number}: {title}", fontsize=10)
    axes.set_xlabel(x, fontsize=9)
    axes.set_ylabel(y, fontsize=9)


def _entropies(axes: Figure, data: list[DataSet]) -> None:
    """Draw the histogram of entropies of all segments, in units of the thesis' deviations."""
    values = []
    for each in data:
        unit = levels(each.names)
        for segment in each.evaluation.segments:
            _, log_determinant = np.linalg.slogdet(segment.covariance / np.outer(unit, unit))
            values.append(0.5 * (len(unit) * (np.log(2.0 * np.pi) + 1.0) + log_determinant))
    axes.hist(values, bins=30)
    _title(axes, "6.5", f"{len(values)} segments", "normalised entropy", "segments")


def _updates(axes: Figure, data: DataSet, batch: F64) -> None:
    """Draw the deviation to the batch after every change of the database, in the order of time."""
    options = dataclasses.replace(OPTIONS, groups=WHOLE)
    records = data.evaluation.records(options, data.evaluation.sigma_ref())
    kept: list[int] = []
    deviations = []
    for number, record in enumerate(records):
        better = sorted([*kept, number], key=lambda row: records[row].scores[WHOLE])[:FEW]
        if number not in better:
            continue
        kept = better
        error = _on(data, [data.evaluation.segments[row].rows for row in sorted(kept)])
        deviations.append((record.begin_ns, _size(data, error - batch)))
    axes.semilogy([size for _, size in deviations], "o-")
    _title(axes, "6.8", "convergence", "change of the database", "deviation to batch")


def _most_and_least(axes: Figure, errors: Figure, data: list[DataSet], batch: list[F64]) -> None:
    """Draw deviations to the batch, and errors, by number of segments."""
    counts = [n for n in _COUNTS if n <= min(len(each.evaluation.segments) for each in data)]
    for name, step in (("most informative", 1), ("least informative", -1)):
        deviation, size = np.zeros((2, len(data), len(counts)))
        for row, each in enumerate(data):
            order = rankings(each.evaluation, "a_optimality", WHOLE)[0][::step]
            for column, count in enumerate(counts):
                error = _on(each, [each.evaluation.segments[k].rows for k in sorted(order[:count])])
                deviation[row, column] = _size(each, error - batch[row])
                size[row, column] = _size(each, error)
        axes.loglog(counts, np.median(deviation, axis=0), "o-", label=name)
        errors.loglog(counts, np.median(size, axis=0), "o-", label=name)
    errors.axhline(np.median([_size(*pair) for pair in zip(data, batch, strict=True)]), ls=":")
    for each, number, what in ((axes, "6.9", "deviation to batch"), (errors, "7.11", "error")):
        each.legend(fontsize=8)
        _title(each, number, f"median of {len(data)} sessions", "segments", what)


def _sessions(axes: Figure, data: list[DataSet]) -> None:
    """Draw errors with the best segments of all sessions so far, and of each session alone."""
    options = dataclasses.replace(OPTIONS, groups=WHOLE, segments_per_group=FEW)
    database, sizes = None, np.zeros((2, len(data)))
    for column, each in enumerate(data):
        database, _ = selection.collect(each.vi_map, options, database)
        alone, _ = selection.collect(each.vi_map, options)
        for row, kept in enumerate((database, alone)):
            sizes[row, column] = _size(each, _error(each, kept.vi_map))
    for values, name in zip(sizes, ("all sessions so far", "one session"), strict=True):
        axes.semilogy(range(1, len(data) + 1), values, "o-", label=name)
    axes.legend(fontsize=8)
    _title(axes, "7.8", f"{FEW} segments", "session", "error")


def _filter(axes: Figure, data: DataSet) -> None:
    """Draw a misalignment that the joint filter estimates, beside those by segments and batch."""
    joint = filter_jointly(data.vi_map, OPTIONS)
    row = joint.parameters.names.index(_MISALIGNMENT)
    start = joint.parameters.difference(joint.before, data.truth)[row]
    time_s = 1e-9 * (data.vi_map.vertices.timestamp_ns - data.vi_map.vertices.timestamp_ns[0])
    change = np.array([each[row] for each in joint.changes])
    axes.plot(time_s[-len(change) :], start + change, label="joint filter")
    order = rankings(data.evaluation, "a_optimality", WHOLE)[0][:FEW]
    column = data.names.index(_MISALIGNMENT)
    eight = _on(data, [data.evaluation.segments[k].rows for k in sorted(order)])
    for error, name, style in (
        (eight, f"{FEW} segments", "--"), (_error(data, data.vi_map), "batch", ":"),
    ):  # fmt: skip
        axes.axhline(error[column], ls=style, color="k", label=name)
    axes.legend(fontsize=8)
    _title(axes, "7.9", _MISALIGNMENT, "time [s]", "error")


def _in_time(axes: Figure, rates: Figure, scenario: Scenario) -> None:
    """Draw the scores of a session's segments over time, the best ones marked, and its turn rates."""
    vi_map = data_set(scenario, 0).maps[0]
    evaluation = selection.evaluate(vi_map, OPTIONS)
    options = dataclasses.replace(OPTIONS, groups=WHOLE, metric="a_optimality")
    records = evaluation.records(options, evaluation.sigma_ref())
    score = np.array([record.scores[WHOLE] for record in records])
    v = vi_map.vertices
    zero_ns = v.timestamp_ns[0]
    time_s = 1e-9 * (np.array([record.begin_ns for record in records]) - zero_ns)
    best = np.argsort(score, kind="stable")[:FEW]
    axes.semilogy(time_s, score, ".-")
    axes.semilogy(time_s[best], score[best], "o", color="C3")
    _title(axes, "7.10", f"the {FEW} best of {len(score)}, navigation", "time [s]", "trace")
    q, dt_s = vi_map.T_G_I[:, :4], 1e-9 * np.diff(v.timestamp_ns)
    turned = np.linalg.norm(so3.log(so3.multiply(so3.inverse(q[:-1]), q[1:])), axis=1) / dt_s
    rates.plot(1e-9 * (v.timestamp_ns[1:] - zero_ns), np.rad2deg(turned), lw=0.7)
    for start in time_s[best]:
        rates.axvspan(start, start + 4.0, color="C3", alpha=0.3)
    _title(rates, "7.10", "turns, the best marked", "time [s]", "deg/s")
