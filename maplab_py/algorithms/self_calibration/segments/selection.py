"""Evaluation of the segments of a map and selection of the most informative (Schneider 2019, algorithm 3)."""

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.self_calibration import device, reports, uncertainty
from maplab_py.algorithms.self_calibration.estimation.parameters import Parameters
from maplab_py.algorithms.self_calibration.estimation.problem import build_segment_problem
from maplab_py.algorithms.self_calibration.options import GROUPS, SelfCalibrationOptions
from maplab_py.algorithms.self_calibration.segments import splitting
from maplab_py.algorithms.self_calibration.segments.database import (
    Key,
    SegmentDatabase,
    SegmentRecord,
)
from maplab_py.array_types import F64, I64
from maplab_py.errors import EstimationError, UserError
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import VIMap, ragged_rows, to_hex


@dataclasses.dataclass(frozen=True, eq=False)
class EvaluatedSegment:
    """A segment and the covariance (k, k) of the calibration given this segment alone."""

    rows: I64  # vertices
    landmarks: int
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
        """Return the median (k,) of the segments' deviations, parameter by parameter."""
        deviations = [_sigma(segment.covariance) for segment in self.segments]
        return np.asarray(np.median(deviations, axis=0), dtype=np.float64)

    def records(self, options: SelfCalibrationOptions, sigma_ref: F64) -> list[SegmentRecord]:
        """Return the records of all segments, scored with reference deviations (k,)."""
        rows = {
            table: self.parameters.of_groups(groups) for table, groups in options.grouping().items()
        }
        return [
            _record(
                self.vi_map,
                segment,
                {
                    table: uncertainty.score(
                        segment.covariance, sigma_ref, of_group, options.metric
                    )
                    for table, of_group in rows.items()
                },
            )
            for segment in self.segments
        ]


def evaluate(
    vi_map: VIMap,
    options: SelfCalibrationOptions,
    *,
    missions: NDArray[np.integer] | None = None,
    progress: Progress = SILENT,
) -> Evaluation:
    """Evaluate every segment of some missions (rows, None = all) alone, at the map's calibration.

    Raises:
        EstimationError: There is no segment.
        UserError: The missions were recorded with different devices.
    """
    device.device_of(vi_map, missions)
    segments = splitting.split_into_segments(vi_map, missions, options.segment_keyframes)
    if not segments:
        raise EstimationError(
            f"no mission has {options.segment_keyframes // 2 + 1} keyframes in a row that inertial "
            "edges join: use a shorter --sc_segment_keyframes"
        )
    began = time.perf_counter()
    results: list[tuple[int, F64 | None]] = []
    parameters = Parameters(())
    for number, rows in enumerate(segments):
        progress.step(number, len(segments), "evaluate segments")
        submap = splitting.extract_submap(vi_map, rows)
        segment_parameters, covariance = _information(submap, options)
        results.append((len(submap.landmarks), covariance))
        parameters = max(parameters, segment_parameters, key=len)
    prior = np.diag(parameters.prior_sigma**2)
    evaluated = []
    for rows, (landmarks, posterior) in zip(segments, results, strict=True):
        is_complete = posterior is not None and len(posterior) == len(parameters)
        covariance = posterior if posterior is not None and is_complete else prior
        unobservable = uncertainty.spectrum(covariance, parameters).unobservable().shape[1]
        evaluated.append(EvaluatedSegment(rows, landmarks, covariance, unobservable))
    seconds = time.perf_counter() - began
    return Evaluation(vi_map, parameters, tuple(evaluated), seconds / len(segments))


def _information(segment: VIMap, options: SelfCalibrationOptions) -> tuple[Parameters, F64 | None]:
    """Return the parameters of a segment and their covariance; None = it has no information."""
    try:
        problem = build_segment_problem(segment, options, robust=False)
        return problem.parameters, uncertainty.posterior_covariance(problem, problem.states)
    except EstimationError:
        return Parameters(()), None


def _sigma(covariance: F64) -> F64:
    return np.asarray(np.sqrt(np.maximum(np.diag(covariance), 0.0)))


def _record(vi_map: VIMap, segment: EvaluatedSegment, scores: dict[str, float]) -> SegmentRecord:
    vertices, rows = vi_map.vertices, segment.rows
    first, last = rows[0], rows[-1]
    edges = np.flatnonzero(
        (vi_map.imu_edges.from_vertex >= first) & (vi_map.imu_edges.to_vertex <= last)
    )
    samples = vi_map.imu_samples.accel_gyro[ragged_rows(vi_map.sample_start, edges)]
    turn_rate = samples[:, 3:] - vertices.gyro_bias[rows].mean(axis=0)
    return SegmentRecord(
        mission=to_hex(vi_map.missions.id[vertices.mission[first]]),
        first_vertex=to_hex(vertices.id[first]),
        last_vertex=to_hex(vertices.id[last]),
        keyframes=len(rows),
        begin_ns=int(vertices.timestamp_ns[first]),
        duration_s=float((vertices.timestamp_ns[last] - vertices.timestamp_ns[first]) * 1e-9),
        scores=scores,
        sigma=tuple(_sigma(segment.covariance).tolist()),
        unobservable=segment.unobservable,
        gyro_rms_radps=float(np.sqrt(np.mean(np.sum(turn_rate**2, axis=1)))),
        accel_change_mps2=float(np.sqrt(np.sum(np.var(samples[:, :3], axis=0)))),
        landmarks=segment.landmarks,
    )


def segment_information(
    vi_map: VIMap,
    options: SelfCalibrationOptions,
    *,
    missions: NDArray[np.integer] | None = None,
    progress: Progress = SILENT,
) -> tuple[reports.InformationReport, list[I64]]:
    """Score every segment alone; return the report and the segments' vertex rows."""
    by_group = dataclasses.replace(options, groups=",".join(GROUPS))
    evaluation = evaluate(vi_map, by_group, missions=missions, progress=progress)
    sigma_ref = evaluation.sigma_ref()
    time_ns = vi_map.vertices.timestamp_ns
    scores = tuple(
        reports.SegmentScore(
            mission=record.mission,
            start_ns=record.begin_ns,
            end_ns=int(time_ns[segment.rows[-1]]),
            **{group: record.scores.get(group, 0.0) for group in GROUPS},
            unobservable=record.unobservable,
            gyro_rms_degps=float(np.rad2deg(record.gyro_rms_radps)),
            accel_change_mps2=record.accel_change_mps2,
        )
        for record, segment in zip(
            evaluation.records(by_group, sigma_ref), evaluation.segments, strict=True
        )
    )
    reference = tuple(
        reports.ParameterReference(parameter.name, parameter.unit, sigma)
        for parameter, sigma in zip(evaluation.parameters.each, sigma_ref.tolist(), strict=True)
    )
    report = reports.InformationReport(options.metric, scores, reference, evaluation.seconds_each)
    return report, [segment.rows for segment in evaluation.segments]


def collect(
    vi_map: VIMap,
    options: SelfCalibrationOptions,
    database: SegmentDatabase | None = None,
    *,
    missions: NDArray[np.integer] | None = None,
    progress: Progress = SILENT,
) -> tuple[SegmentDatabase, reports.CollectionReport]:
    """Evaluate a map's segments and keep the best of them and of the database.

    New segments of a mission replace those in the database. A map whose calibration differs from the
    database's is evaluated at the database's, so that scores are comparable; its segments keep their
    measurements and states.

    Args:
        vi_map: Map of one or more missions of one device.
        database: What was collected before; None = an empty one.

    Raises:
        UserError: The database was made for other parameters, tables or cameras.
        EstimationError: There is no segment.
    """
    chosen = np.arange(len(vi_map.missions)) if missions is None else np.asarray(missions)
    device.device_of(vi_map, chosen)
    source = splitting.extract_submap(
        vi_map, np.flatnonzero(np.isin(vi_map.vertices.mission, chosen))
    )
    if database is not None and len(database):
        source = device.with_device_of(source, database.vi_map)
    evaluation = evaluate(source, options, progress=progress)
    if database is None or not len(database):
        database = empty_database(
            evaluation.vi_map, evaluation.parameters, evaluation.sigma_ref(), options
        )
    records = evaluation.records(options, database.sigma_ref)
    kept, dropped = keep_best(database, evaluation.vi_map, evaluation.parameters, records, options)
    new = {record.key for record in records}
    report = reports.CollectionReport(
        segments_evaluated=len(records),
        segments_kept=len(kept),
        from_this_map=sum(record.key in new for record in kept.records),
        dropped=dropped,
        seconds_per_segment=evaluation.seconds_each,
        segments=kept_segments(kept),
    )
    return kept, report


def empty_database(
    vi_map: VIMap, parameters: Parameters, sigma_ref: F64, options: SelfCalibrationOptions
) -> SegmentDatabase:
    """Return a database without segments for the device of a map and reference deviations (k,)."""
    return SegmentDatabase(
        vi_map=VIMap(sensors=vi_map.sensors),
        records=(),
        tables=options.grouping(),
        metric=options.metric,
        capacity=options.segments_per_group,
        parameter_names=parameters.names,
        sigma_ref=sigma_ref,
        selection=options.selection,
    )


def keep_best(
    database: SegmentDatabase,
    vi_map: VIMap,
    parameters: Parameters,
    records: Sequence[SegmentRecord],
    options: SelfCalibrationOptions,
) -> tuple[SegmentDatabase, int]:
    """Return the best segments of a database and of a map, and how many of the former were dropped.

    Segments of the same missions, or of the same recordings, are replaced.

    Raises:
        UserError: The database was made for other parameters, tables or cameras.
    """
    _check_options(database, options, parameters)
    repeated = database.missions_recorded_in(vi_map) | {record.mission for record in records}
    before = database.without_missions(repeated)
    best = _best(before, records, options)
    added = before.with_segments(vi_map, [record for record in records if record.key in best])
    dropped = sum(record.key not in best for record in before.records)
    return added.with_only(best), dropped


def _check_options(
    database: SegmentDatabase, options: SelfCalibrationOptions, parameters: Parameters
) -> None:
    """Refuse options that differ from those with which a database was collected."""
    is_different = {
        "--sc_states": database.parameter_names != parameters.names,
        "--sc_groups": dict(database.tables) != options.grouping(),
        "--sc_metric": database.metric != options.metric,
        "--sc_selection": database.selection != options.selection,
        "--sc_segments_per_group": database.capacity != options.segments_per_group,
    }
    if flags := [flag for flag, differs in is_different.items() if differs]:
        raise UserError(
            f"the database was collected with another {flags[0]}: give the same, or begin another "
            "database file"
        )


def _best(
    before: SegmentDatabase, records: Sequence[SegmentRecord], options: SelfCalibrationOptions
) -> set[Key]:
    """Return the keys of the segments to keep, of those in the database and the new ones."""
    every = dataclasses.replace(before, records=(*before.records, *records))
    if options.selection == "all":
        return {record.key for record in every.records}
    if options.selection == "random":
        budget = options.segments_per_group * len(options.grouping())
        informative = dataclasses.replace(every, selection="informative").members()
        count = min(len(every.records), len(informative), budget)
        rng = np.random.default_rng(options.seed)
        chosen = rng.choice(len(every.records), size=count, replace=False)
        return {every.records[int(row)].key for row in chosen}
    return set(every.members())


def kept_segments(database: SegmentDatabase) -> tuple[reports.KeptSegment, ...]:
    """Return the rows of a report on the segments of a database, in the order of time."""
    members = database.members()
    begin: dict[str, int] = {}
    for record in database.records:
        begin[record.mission] = min(begin.get(record.mission, record.begin_ns), record.begin_ns)
    return tuple(
        reports.KeptSegment(
            mission=record.mission[:8],
            begin_s=(record.begin_ns - begin[record.mission]) * 1e-9,
            duration_s=record.duration_s,
            keyframes=record.keyframes,
            landmarks=record.landmarks,
            kept_for=", ".join(members.get(record.key, ())),
            gyro_rms_degps=float(np.rad2deg(record.gyro_rms_radps)),
            accel_change_mps2=record.accel_change_mps2,
            unobservable=record.unobservable,
        )
        for record in sorted(database.records, key=lambda record: (record.mission, record.begin_ns))
    )


def describe_database(database: SegmentDatabase, file: Path) -> reports.DatabaseReport:
    """Return tables, scores, parameters and segments of a database that was read from a file."""
    tables = []
    for name in database.tables:
        scores = [record.scores[name] for record in database.ranked(name)]
        best, worst = (min(scores), max(scores)) if scores else (float("nan"), float("nan"))
        tables.append(reports.DatabaseTable(name, len(scores), best, worst))
    sigma = [record.sigma for record in database.records] or [
        (float("nan"),) * len(database.sigma_ref)
    ]
    columns = zip(
        database.parameter_names,
        database.sigma_ref.tolist(),
        np.min(sigma, axis=0).tolist(),
        strict=True,
    )
    vi_map = database.vi_map
    return reports.DatabaseReport(
        file=file,
        metric=database.metric,
        selection=database.selection,
        capacity=database.capacity,
        sessions=len(vi_map.missions),
        keyframes=len(vi_map.vertices),
        landmarks=len(vi_map.landmarks),
        imu_samples=len(vi_map.imu_samples),
        tables=tuple(tables),
        parameters=tuple(reports.DatabaseParameter(*column) for column in columns),
        segments=kept_segments(database),
    )
