"""Evaluate the segments of a map and keep the most informative ones (thesis algorithm 3)."""

from __future__ import annotations

import dataclasses
import time

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.self_calibration.database import (
    SegmentDatabase,
    SegmentRecord,
    device_of,
    with_device,
)
from maplab_py.algorithms.self_calibration.information import (
    posterior_covariance,
    reference_sigma,
    score,
    spectrum,
)
from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.algorithms.self_calibration.parameters import Parameters
from maplab_py.algorithms.self_calibration.problem import pose
from maplab_py.algorithms.self_calibration.reports import CollectionReport, KeptSegment
from maplab_py.algorithms.self_calibration.segments import cut, restricted
from maplab_py.errors import EstimationError, UserError
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import VIMap
from maplab_py.vimap.ids import to_hex
from maplab_py.vimap.table import ragged_rows

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


@dataclasses.dataclass(frozen=True, eq=False)
class EvaluatedSegment:
    """A segment and the covariance (k, k) of the calibration that it alone leaves."""

    rows: I64  # vertices
    covariance: F64
    unobservable: int


@dataclasses.dataclass(frozen=True, eq=False)
class Evaluation:
    """All segments of some missions, evaluated at one calibration."""

    vi_map: VIMap
    parameters: Parameters
    segments: tuple[EvaluatedSegment, ...]
    seconds_each: float

    def sigma_ref(self) -> F64:
        """Return the usual deviations (k,) of a segment."""
        return reference_sigma([one.covariance for one in self.segments])


def evaluate(
    vi_map: VIMap,
    options: SelfCalibrationOptions,
    *,
    missions: NDArray[np.integer] | None = None,
    progress: Progress = SILENT,
) -> Evaluation:
    """Return the information of every segment by itself, at the map's calibration.

    Raises:
        EstimationError: There is no segment.
        UserError: The missions were recorded with different devices.
    """
    device_of(vi_map, missions)
    runs = cut(vi_map, missions, options.segment_keyframes)
    if not runs:
        raise EstimationError(
            f"no mission has {options.segment_keyframes // 2 + 1} keyframes in a row that inertial "
            "edges join: use a shorter --sc_segment_keyframes"
        )
    began = time.perf_counter()
    covariances: list[F64 | None] = []
    parameters = Parameters(())
    for number, rows in enumerate(runs):
        progress.step(number, len(runs), "evaluate segments")
        own, covariance = _information(restricted(vi_map, rows), options)
        covariances.append(covariance)
        parameters = max(parameters, own, key=len)
    nothing = np.diag(parameters.prior_sigma**2)
    found = []
    for rows, covariance in zip(runs, covariances, strict=True):
        known = nothing
        if covariance is not None and len(covariance) == len(parameters):
            known = covariance
        unobservable = spectrum(known, parameters).unobservable().shape[1]
        found.append(EvaluatedSegment(rows, known, unobservable))
    seconds = time.perf_counter() - began
    return Evaluation(vi_map, parameters, tuple(found), seconds / len(runs))


def _information(segment: VIMap, options: SelfCalibrationOptions) -> tuple[Parameters, F64 | None]:
    """Return the parameters that a segment has and their covariance; None = it tells nothing."""
    try:
        problem = pose(segment, options, robust=False)
        return problem.parameters, posterior_covariance(problem, problem.posed.states)
    except EstimationError:
        return Parameters(()), None


def records_of(
    evaluation: Evaluation, options: SelfCalibrationOptions, sigma_ref: F64
) -> list[SegmentRecord]:
    """Score segments against reference deviations (k,)."""
    tables, parameters = options.grouping(), evaluation.parameters
    rows = {name: parameters.of_groups(groups) for name, groups in tables.items()}
    records = []
    for one in evaluation.segments:
        scores = {
            name: score(one.covariance, sigma_ref, own, options.metric)
            for name, own in rows.items()
        }
        records.append(_record(evaluation.vi_map, one, scores))
    return records


def _record(vi_map: VIMap, one: EvaluatedSegment, scores: dict[str, float]) -> SegmentRecord:
    vertices, rows = vi_map.vertices, one.rows
    edges = np.flatnonzero(
        (vi_map.imu_edges.from_vertex >= rows[0]) & (vi_map.imu_edges.to_vertex <= rows[-1])
    )
    samples = vi_map.imu_samples.accel_gyro[ragged_rows(vi_map.sample_start, edges)]
    turning = samples[:, 3:] - vertices.gyro_bias[rows].mean(axis=0)
    own = restricted(vi_map, rows)
    return SegmentRecord(
        mission=to_hex(vi_map.missions.id[vertices.mission[rows[0]]]),
        first_vertex=to_hex(vertices.id[rows[0]]),
        last_vertex=to_hex(vertices.id[rows[-1]]),
        keyframes=len(rows),
        begin_ns=int(vertices.timestamp_ns[rows[0]]),
        duration_s=float((vertices.timestamp_ns[rows[-1]] - vertices.timestamp_ns[rows[0]]) * 1e-9),
        scores=scores,
        sigma=tuple(np.sqrt(np.maximum(np.diag(one.covariance), 0.0)).tolist()),
        unobservable=one.unobservable,
        gyro_rms_radps=float(np.sqrt(np.mean(np.sum(turning**2, axis=1)))),
        accel_change_mps2=float(np.sqrt(np.sum(np.var(samples[:, :3], axis=0)))),
        landmarks=len(own.landmarks),
    )


def collect(
    vi_map: VIMap,
    options: SelfCalibrationOptions,
    database: SegmentDatabase | None = None,
    *,
    missions: NDArray[np.integer] | None = None,
    progress: Progress = SILENT,
) -> tuple[SegmentDatabase, CollectionReport]:
    """Evaluate a map's segments and keep the best of them and of the database.

    Segments of a mission that the database knows are evaluated anew and replace the old ones. A map
    whose calibration differs from the database's is evaluated at the database's, so that scores
    compare; its segments keep their measurements and states.

    Args:
        vi_map: Map of one or more missions of one device.
        options: What to estimate, tables, metric, capacity.
        database: What was collected before; None = begin.
        missions: Missions (rows, None = all).
        progress: Shown while segments are evaluated.

    Raises:
        UserError: The database was made for other parameters, tables or cameras.
        EstimationError: There is no segment.
    """
    chosen = np.arange(len(vi_map.missions)) if missions is None else np.asarray(missions)
    device_of(vi_map, chosen)
    source = restricted(vi_map, np.flatnonzero(np.isin(vi_map.vertices.mission, chosen)))
    if database is not None and len(database):
        source = with_device(source, database.vi_map)
    evaluation = evaluate(source, options, progress=progress)
    if database is None or not len(database):
        sigma_ref = evaluation.sigma_ref()
        database = _empty(source, options, evaluation.parameters, sigma_ref)
    _check_fits(database, options, evaluation.parameters)
    records = records_of(evaluation, options, database.sigma_ref)
    before = database.without_missions({one.mission for one in records})
    best = _best(before, records, options)
    kept = before.with_segments(evaluation.vi_map, [one for one in records if one.key in best])
    kept = kept.only([one for one in kept.records if one.key in best])
    new = {one.key for one in records}
    report = CollectionReport(
        segments_evaluated=len(records),
        segments_kept=len(kept),
        from_this_map=sum(one.key in new for one in kept.records),
        dropped=sum(one.key not in best for one in before.records),
        seconds_per_segment=evaluation.seconds_each,
        segments=kept_segments(kept),
    )
    return kept, report


def _empty(
    vi_map: VIMap, options: SelfCalibrationOptions, parameters: Parameters, sigma_ref: F64
) -> SegmentDatabase:
    return SegmentDatabase(
        VIMap(sensors=vi_map.sensors),
        (),
        options.grouping(),
        options.metric,
        options.segments_per_group,
        parameters.names,
        sigma_ref,
        options.selection,
    )


def _check_fits(
    database: SegmentDatabase, options: SelfCalibrationOptions, parameters: Parameters
) -> None:
    differing = {
        "--sc_states": database.parameter_names != parameters.names,
        "--sc_groups": dict(database.tables) != options.grouping(),
        "--sc_metric": database.metric != options.metric,
        "--sc_selection": database.selection != options.selection,
        "--sc_segments_per_group": database.capacity != options.segments_per_group,
    }
    if changed := [flag for flag, differs in differing.items() if differs]:
        raise UserError(
            f"the database was collected with another {changed[0]}: give the same, or begin another "
            "database file"
        )


def _best(
    before: SegmentDatabase, records: list[SegmentRecord], options: SelfCalibrationOptions
) -> set[tuple[str, str]]:
    """Return the keys of the segments to keep, of those in the database and the new ones."""
    every = dataclasses.replace(before, records=(*before.records, *records))
    if options.selection == "all":
        return {one.key for one in every.records}
    if options.selection == "random":
        budget = options.segments_per_group * len(options.grouping())
        informative = dataclasses.replace(every, selection="informative").members()
        count = min(len(every.records), len(informative), budget)
        rng = np.random.default_rng(options.seed)
        chosen = rng.choice(len(every.records), size=count, replace=False)
        return {every.records[int(row)].key for row in chosen}
    return set(every.members())


def kept_segments(database: SegmentDatabase) -> tuple[KeptSegment, ...]:
    """Return what a user wants to know of every segment, in the order of time."""
    members = database.members()
    begin: dict[str, int] = {}
    for one in database.records:
        begin[one.mission] = min(begin.get(one.mission, one.begin_ns), one.begin_ns)
    return tuple(
        KeptSegment(
            mission=one.mission[:8],
            begin_s=(one.begin_ns - begin[one.mission]) * 1e-9,
            duration_s=one.duration_s,
            keyframes=one.keyframes,
            landmarks=one.landmarks,
            kept_for=", ".join(members.get(one.key, ())),
            gyro_rms_degps=float(np.rad2deg(one.gyro_rms_radps)),
            accel_change_mps2=one.accel_change_mps2,
            unobservable=one.unobservable,
        )
        for one in sorted(database.records, key=lambda one: (one.mission, one.begin_ns))
    )
