"""Commands that calibrate a device from its own maps, on their most informative pieces."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from maplab_py.algorithms.self_calibration.database_reports import (
    DatabaseParameter,
    DatabaseReport,
    DatabaseTable,
    PrunedSegment,
    PruneReport,
)
from maplab_py.algorithms.self_calibration.limits import checked
from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.algorithms.self_calibration.reports import (
    CalibrationComparison,
    CollectionReport,
    InformationReport,
    SelfCalibrationReport,
)
from maplab_py.plugin import (
    CommandContext,
    Message,
    Report,
    UserError,
    check_writable,
    command,
    write_text,
)

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from maplab_py.algorithms.self_calibration.database import SegmentDatabase
    from maplab_py.sensors import SensorSet

_OPTIONS = SelfCalibrationOptions()


@dataclasses.dataclass(frozen=True)
class ExportedFiles(Report):
    """Files that were written."""

    files: tuple[Path, ...]


@command(
    "self_calibrate",
    "self-calibrate",
    example="self_calibrate --database=device.segments --dry_run",
    see_also=("collect_segments", "apply_calibration", "optimize_visual_inertial"),
)
def self_calibrate(
    context: CommandContext,
    *,
    options: SelfCalibrationOptions = _OPTIONS,
    database: Path | None = None,
    batch: bool = False,
    joint_ekf: bool = False,
    max_camera_shift_m: float = 0.025,
    parts: int = 0,
    dry_run: bool = False,
    map_mission: str = "",
    map_mission_list: str = "",
) -> SelfCalibrationReport:
    """Calibrate cameras and IMU on the most informative segments of the map and of a database.

    Args:
        database: Segment database: segments of earlier sessions take part, the map's are added.
        batch: Use all data of the missions instead of segments.
        joint_ekf: For comparison: estimate IMU and mounting by a Kalman filter that runs along the
            missions; camera intrinsics are held.
        max_camera_shift_m: When the data would move a camera on the IMU farther than this, its
            position is kept and the rest calibrated again; 0 = believe the data.
        parts: Calibrate on so many parts of the data too; deviations are then at least what the
            spread of the results says, and errors of the model show. 0 = formal deviations.
        dry_run: Only report; neither the map nor the database changes.
        map_mission: Mission id or unambiguous prefix; empty = all missions.
        map_mission_list: Several missions, separated by commas.
    """
    from maplab_py.algorithms.self_calibration.database_file import save_database
    from maplab_py.algorithms.self_calibration.plausibility import calibrate_plausibly

    missions = context.mission_rows(map_mission, map_mission_list)
    if (batch or joint_ekf) and database is not None:
        raise UserError("--database goes with segments, neither with --batch nor with --joint_ekf")
    if batch and joint_ekf:
        raise UserError("choose one of --batch and --joint_ekf")
    if not max_camera_shift_m >= 0.0:
        raise UserError(f"--max_camera_shift_m={max_camera_shift_m:g}: wants 0 or more")
    if joint_ekf:
        return _filter(context, checked(options), missions, dry_run=dry_run)
    sensors, collected, report = calibrate_plausibly(
        context.vi_map,
        checked(options),
        max_camera_shift_m=max_camera_shift_m,
        parts=parts,
        database=_existing(database),
        missions=missions,
        batch=batch,
        progress=context.progress,
    )
    if not dry_run:
        context.commit(context.vi_map.replace(sensors=sensors))
        if database is not None and collected is not None:
            save_database(collected, database)
    return report


def _filter(
    context: CommandContext,
    options: SelfCalibrationOptions,
    missions: NDArray[np.int64] | None,
    *,
    dry_run: bool,
) -> SelfCalibrationReport:
    from maplab_py.algorithms.self_calibration.ekf_report import report_of
    from maplab_py.algorithms.self_calibration.joint_ekf import filter_jointly

    result = filter_jointly(context.vi_map, options, missions=missions, progress=context.progress)
    if not dry_run:
        context.commit(context.vi_map.replace(sensors=result.sensors))
    return report_of(result)


@command(
    "collect_segments",
    example="collect_segments --database=device.segments",
    see_also=("segment_database_stats", "self_calibrate"),
    acts_outside=True,
)
def collect_segments(
    context: CommandContext,
    *,
    database: Path,
    options: SelfCalibrationOptions = _OPTIONS,
    dry_run: bool = False,
    map_mission: str = "",
    map_mission_list: str = "",
) -> CollectionReport:
    """Add the map's most informative segments to a database file, which is made when it is missing.

    Args:
        database: Segment database.
        dry_run: Only report; the database stays as it is.
        map_mission: Mission id or unambiguous prefix; empty = all missions.
        map_mission_list: Several missions, separated by commas.
    """
    from maplab_py.algorithms.self_calibration.collection import collect
    from maplab_py.algorithms.self_calibration.database_file import save_database

    collected, report = collect(
        context.vi_map,
        checked(options),
        _existing(database),
        missions=context.mission_rows(map_mission, map_mission_list),
        progress=context.progress,
    )
    if not dry_run:
        save_database(collected, database)
    return report


@command(
    "segment_database_stats",
    example="segment_database_stats --database=device.segments",
    needs_map=False,
)
def segment_database_stats(context: CommandContext, *, database: Path) -> DatabaseReport:  # noqa: ARG001
    """Show what a segment database holds: tables, scores, parameters, segments.

    Args:
        database: Segment database.
    """
    import numpy as np

    from maplab_py.algorithms.self_calibration.collection import kept_segments
    from maplab_py.algorithms.self_calibration.database_file import load_database

    found = load_database(database)
    tables = []
    for name in found.tables:
        scores = [one.scores[name] for one in found.ranked(name)] or [float("nan")]
        tables.append(DatabaseTable(name, len(found.ranked(name)), min(scores), max(scores)))
    sigma = np.array([one.sigma for one in found.records]).reshape(len(found), -1)
    best = sigma.min(axis=0) if len(found) else np.full(len(found.parameter_names), np.nan)
    parameters = tuple(
        DatabaseParameter(name, float(usual), float(least))
        for name, usual, least in zip(found.parameter_names, found.sigma_ref, best, strict=True)
    )
    return DatabaseReport(
        file=database,
        metric=found.metric,
        selection=found.selection,
        capacity=found.capacity,
        sessions=len(found.vi_map.missions),
        keyframes=len(found.vi_map.vertices),
        landmarks=len(found.vi_map.landmarks),
        imu_samples=len(found.vi_map.imu_samples),
        tables=tuple(tables),
        parameters=parameters,
        segments=kept_segments(found),
    )


@command(
    "prune_segments",
    example="prune_segments --database=device.segments --outdated --dry_run",
    needs_map=False,
    see_also=("segment_database_stats",),
    acts_outside=True,
)
def prune_segments(
    context: CommandContext,
    *,
    database: Path,
    options: SelfCalibrationOptions = _OPTIONS,
    segments_per_group: int = 0,
    missions: str = "",
    outdated: bool = False,
    calibration: Path | None = None,
    probability: float = 0.999,
    dry_run: bool = False,
) -> PruneReport:
    """Remove segments: beyond a capacity, of some missions, or that no longer fit the calibration.

    Args:
        database: Segment database.
        segments_per_group: Keep so many per group; 0 = as many as it has.
        missions: Remove the segments of missions whose ids begin so, separated by commas.
        outdated: Remove segments whose measurements contradict the calibration.
        calibration: Test against this sensors.yaml or map folder; empty = against the calibration
            that all segments make together.
        probability: Of calling a segment good that is.
        dry_run: Only report; the database stays as it is.
    """
    from maplab_py.algorithms.self_calibration.database_file import load_database, save_database
    from maplab_py.algorithms.self_calibration.outdated import fits, fits_together

    if not 0.0 < probability < 1.0:
        raise UserError(f"--probability={probability:g}: wants a number between 0 and 1")
    before = load_database(database)
    result, tested = before, []
    prefixes = tuple(filter(None, (part.strip() for part in missions.split(","))))
    if prefixes:
        gone = {one.mission for one in before.records if one.mission.startswith(prefixes)}
        if not gone:
            raise UserError(f"--missions: the database has no segment of {missions}")
        result = result.without_missions(gone)
    if outdated:
        if calibration is None:
            tested = fits_together(result, checked(options), probability, context.progress)
        else:
            now = _sensors_of(calibration)
            tested = fits(result, now, checked(options), probability, context.progress)
        bad = {one.first_vertex for one in tested if one.is_outdated}
        result = result.without({r.key for r in result.records if r.first_vertex in bad})
    if segments_per_group:
        result = result.pruned(segments_per_group)
    if not dry_run:
        save_database(result, database)
    return PruneReport(
        len(before),
        len(result),
        tuple(
            PrunedSegment(
                one.mission,
                one.first_vertex[:8],
                one.distance,
                one.limit,
                one.chi_square_per_freedom,
                one.is_outdated,
            )
            for one in tested
        ),
    )


@command(
    "export_segments",
    example="export_segments --database=device.segments --map_folder=segments",
    needs_map=False,
    acts_outside=True,
)
def export_segments(
    context: CommandContext, *, database: Path, map_folder: Path, overwrite: bool = False
) -> Message:
    """Write the segments of a database as a map that can be loaded, looked at and optimised.

    Args:
        database: Segment database.
        map_folder: Where to.
        overwrite: Replace a map that is there.
    """
    from maplab_py.algorithms.self_calibration.database_file import load_database
    from maplab_py.storage.native import save_map

    found = load_database(database)
    save_map(found.vi_map, map_folder, overwrite=overwrite, progress=context.progress)
    return Message(f"{len(found)} segments of {len(found.vi_map.missions)} missions: {map_folder}")


@command(
    "evaluate_segment_information",
    example="evaluate_segment_information --plot=information.svg",
    see_also=("collect_segments",),
    writes_files=True,
)
def evaluate_segment_information(
    context: CommandContext,
    *,
    options: SelfCalibrationOptions = _OPTIONS,
    group: Literal["imu", "camera", "extrinsics"] = "imu",
    plot: Path | None = None,
    csv: Path | None = None,
    map_mission: str = "",
    map_mission_list: str = "",
    overwrite: bool = False,
) -> InformationReport:
    """Say how informative every segment is for each group of parameters; less is more.

    Args:
        group: Group that the plot and the file show.
        plot: Write the trajectory from above, coloured by information, to this SVG file.
        csv: Write segments with their information to this file, which the viewer reads.
        map_mission: Mission id or unambiguous prefix; empty = all missions.
        map_mission_list: Several missions, separated by commas.
        overwrite: Replace files that exist.
    """
    import numpy as np

    from maplab_py.algorithms.self_calibration import drawing, workflow

    for file in (plot, csv):
        if file is not None:
            check_writable(file, overwrite=overwrite)
    report, segments = workflow.segment_information(
        context.vi_map,
        checked(options),
        missions=context.mission_rows(map_mission, map_mission_list),
        progress=context.progress,
    )
    values = np.array([getattr(one, group) for one in report.segments])
    if plot is not None:
        title = f"information about {group} ({options.metric.replace('_', '-')})"
        write_text(
            plot, [drawing.draw(context.vi_map, segments, values, title)], overwrite=overwrite
        )
    if csv is not None:
        rows = [
            (one.mission, one.start_ns, one.end_ns, getattr(one, group)) for one in report.segments
        ]
        write_text(csv, [drawing.as_csv(rows)], overwrite=overwrite)
    return report


@command(
    "apply_calibration",
    example="apply_calibration --calibration=sensors.yaml",
    see_also=("compare_calibrations", "export_calibration"),
)
def apply_calibration(
    context: CommandContext,
    *,
    calibration: Path,
    map_mission: str = "",
    map_mission_list: str = "",
) -> CalibrationComparison:
    """Give the map's device the calibration of a sensors.yaml or of another map; poses stay.

    Args:
        calibration: sensors.yaml, map folder, or segment database.
        map_mission: Mission id or unambiguous prefix; empty = all missions.
        map_mission_list: Several missions, separated by commas.
    """
    from maplab_py.algorithms.self_calibration import comparison, database, workflow

    missions = context.mission_rows(map_mission, map_mission_list)
    before = context.vi_map
    after = workflow.applied(before, _sensors_of(calibration), missions=missions)
    context.commit(after)
    ids = database.device_of(before, missions)
    return comparison.compare(before.sensors, ids, after.sensors, ids)


@command(
    "export_calibration",
    example="export_calibration --format=kalibr --folder=calibration",
    see_also=("apply_calibration",),
    writes_files=True,
)
def export_calibration(
    context: CommandContext,
    *,
    folder: Path,
    format: Literal["maplab", "kalibr", "openvins", "basalt"] = "maplab",
    map_mission: str = "",
    map_mission_list: str = "",
    overwrite: bool = False,
) -> ExportedFiles:
    """Write the calibration of the map's device for maplab, kalibr, OpenVINS or Basalt.

    Args:
        folder: Where to; made when it is missing.
        format: Whose format.
        map_mission: Mission id or unambiguous prefix; empty = all missions.
        map_mission_list: Several missions, separated by commas.
        overwrite: Replace files that exist.
    """
    import numpy as np

    from maplab_py.algorithms.self_calibration import database, export

    vi_map = context.vi_map
    ids = database.device_of(vi_map, context.mission_rows(map_mission, map_mission_list))
    steps = np.diff(vi_map.imu_samples.timestamp_ns)
    steps = steps[(steps > 0) & (steps < 1e9)]
    rate = round(1e9 / float(np.median(steps)), 3) if len(steps) else 200.0
    contents = export.exported(vi_map.sensors, *ids, format, imu_rate_hz=rate)
    for name in contents:
        check_writable(folder / name, overwrite=overwrite)
    for name, text in contents.items():
        write_text(folder / name, [text], overwrite=overwrite)
    return ExportedFiles(tuple(folder / name for name in contents))


@command(
    "compare_calibrations",
    example="compare_calibrations --calibration=sensors.yaml",
    see_also=("apply_calibration",),
)
def compare_calibrations(
    context: CommandContext,
    *,
    calibration: Path,
    map_mission: str = "",
    map_mission_list: str = "",
) -> CalibrationComparison:
    """Compare the calibration of the map's device with another, parameter by parameter.

    Args:
        calibration: sensors.yaml, map folder, or segment database.
        map_mission: Mission id or unambiguous prefix; empty = all missions.
        map_mission_list: Several missions, separated by commas.
    """
    from maplab_py.algorithms.self_calibration import comparison, database, workflow

    vi_map, other = context.vi_map, _sensors_of(calibration)
    ids = database.device_of(vi_map, context.mission_rows(map_mission, map_mission_list))
    known = all(sensor_id in other.sensors for sensor_id in ids)
    other_ids = ids if known else workflow.only_device(other)
    return comparison.compare(vi_map.sensors, ids, other, other_ids)


def _existing(path: Path | None) -> SegmentDatabase | None:
    from maplab_py.algorithms.self_calibration.database_file import load_database

    return load_database(path) if path is not None and path.exists() else None


def _sensors_of(path: Path) -> SensorSet:
    """Read the sensors of a sensors.yaml, a map folder or a segment database."""
    from maplab_py.algorithms.self_calibration.database_file import load_database
    from maplab_py.sensors.sensors_yaml import read_sensors

    for file in (path / "vi_map" / "sensors.yaml", path / "sensors.yaml"):
        if path.is_dir() and file.is_file():
            return read_sensors(file)
    if path.is_file() and path.suffix not in (".yaml", ".yml"):
        return load_database(path).vi_map.sensors
    if not path.is_file():
        raise UserError(f"{path}: there is no such calibration (sensors.yaml or map folder)")
    return read_sensors(path)
