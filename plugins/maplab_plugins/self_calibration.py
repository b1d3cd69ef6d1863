"""Commands that calibrate a device from informative segments of its own maps."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.input_files import SizeOptions
from maplab_py.online_calibration.options import WantedSigmas
from maplab_py.plugin import (
    ALL_MISSIONS,
    CommandContext,
    Message,
    MissionChoice,
    Report,
    UserError,
    check_writable,
    command,
    write_text,
)
from maplab_py.report import counted

if TYPE_CHECKING:
    from maplab_py.algorithms.self_calibration import reports
    from maplab_py.algorithms.self_calibration.segments.database import SegmentDatabase
    from maplab_py.online_calibration.suggestions import SuggestionReport


class ExportedFiles(Report):
    """Files that were written."""

    files: tuple[Path, ...]


@command(
    "self_calibrate",
    "self-calibrate",
    example="self_calibrate --database=device.segments --dry_run",
    see_also=("collect_segments", "apply_calibration", "optimize_visual_inertial"),
    writes_files=True,
)
def self_calibrate(
    context: CommandContext,
    *,
    options: SelfCalibrationOptions = SelfCalibrationOptions(),
    database: Path | None = None,
    batch: bool = False,
    max_camera_shift_m: float = 0.025,
    parts: int = 0,
    chosen: MissionChoice = ALL_MISSIONS,
    size: SizeOptions = SizeOptions(),
) -> reports.SelfCalibrationReport:
    """Calibrate cameras and IMU on the most informative segments of the map and of a database.

    Args:
        database: Segment database: its segments are used too, and the map's are added to it.
        batch: Use all data of the missions instead of segments.
        max_camera_shift_m: If the data would move a camera on the IMU farther than this, keep its
            position and calibrate the rest again; 0 = no limit.
        parts: Calibrate on so many parts of the data too; reported deviations are then at least the
            spread of the results, which contains errors of the models. 0 = none.
    """
    missions = chosen.rows(context.vi_map)
    if batch and database is not None:
        raise UserError("--database needs segments: it cannot be combined with --batch")
    if not max_camera_shift_m >= 0.0:
        raise UserError(f"--max_camera_shift_m={max_camera_shift_m:g}: must be 0 or more")
    from maplab_py.algorithms.self_calibration.checks import calibrate_with_checks
    from maplab_py.algorithms.self_calibration.segments.database import (
        locked_database,
        save_database,
    )

    with locked_database(None if context.is_trial else database):
        sensors, collected, report = calibrate_with_checks(
            context.vi_map,
            options,
            max_camera_shift_m=max_camera_shift_m,
            parts=parts,
            database=_existing(database, size),
            missions=missions,
            batch=batch,
            progress=context.progress,
        )
        context.progress.check()
        context.commit(context.vi_map.replace(sensors=sensors))
        if database is not None and collected is not None:
            save_database(collected, database)
    return report


@command(
    "collect_segments",
    example="collect_segments --database=device.segments",
    see_also=("segment_database_stats", "self_calibrate"),
    writes_files=True,
)
def collect_segments(
    context: CommandContext,
    *,
    database: Path,
    options: SelfCalibrationOptions = SelfCalibrationOptions(),
    chosen: MissionChoice = ALL_MISSIONS,
    size: SizeOptions = SizeOptions(),
) -> reports.CollectionReport:
    """Add the most informative segments of the map to a database file; it is created if missing."""
    from maplab_py.algorithms.self_calibration.segments.database import (
        locked_database,
        save_database,
    )
    from maplab_py.algorithms.self_calibration.segments.selection import collect

    with locked_database(None if context.is_trial else database):
        collected, report = collect(
            context.vi_map,
            options,
            _existing(database, size),
            missions=chosen.rows(context.vi_map),
            progress=context.progress,
        )
        save_database(collected, database)
    return report


@command(
    "segment_database_stats",
    example="segment_database_stats --database=device.segments",
    needs_map=False,
    reads=("database",),
)
def segment_database_stats(
    _: CommandContext, *, database: Path, size: SizeOptions = SizeOptions()
) -> reports.DatabaseReport:
    """Show tables, scores, parameters and segments of a segment database."""
    from maplab_py.algorithms.self_calibration.segments.database import load_database
    from maplab_py.algorithms.self_calibration.segments.selection import describe_database

    return describe_database(load_database(database, size.max_bytes), database)


@command(
    "prune_segments",
    example="prune_segments --database=device.segments --outdated --dry_run",
    needs_map=False,
    see_also=("segment_database_stats",),
    writes_files=True,
    reads=("database",),
)
def prune_segments(
    context: CommandContext,
    *,
    database: Path,
    options: SelfCalibrationOptions = SelfCalibrationOptions(),
    segments_per_group: int = 0,
    missions: str = "",
    outdated: bool = False,
    calibration: Path | None = None,
    probability: float = 0.999,
    size: SizeOptions = SizeOptions(),
) -> reports.PruneReport:
    """Remove segments: beyond a capacity, of some missions, or that contradict the calibration.

    Args:
        segments_per_group: Number of segments to keep per group; 0 = all.
        missions: Remove the segments of missions whose ids begin with these digits, separated by commas.
        outdated: Remove segments whose measurements contradict the calibration.
        calibration: Test against this sensors.yaml or map folder; empty = against the joint
            calibration of all segments.
        probability: Of accepting a segment if the calibration is right.
    """
    from maplab_py.algorithms.self_calibration.pruning import prune
    from maplab_py.algorithms.self_calibration.segments.database import (
        load_database,
        locked_database,
        read_calibration,
        save_database,
    )

    if not 0.0 < probability < 1.0:
        raise UserError(f"--probability={probability:g}: must be between 0 and 1")
    with locked_database(None if context.is_trial else database):
        result, report = prune(
            load_database(database, size.max_bytes),
            options,
            missions=[part.strip() for part in missions.split(",") if part.strip()],
            outdated=outdated,
            calibration=read_calibration(calibration, size.max_bytes)
            if outdated and calibration
            else None,
            probability=probability,
            capacity=segments_per_group,
            progress=context.progress,
        )
        save_database(result, database)
    return report


@command(
    "suggest_motion",
    example="suggest_motion --database=device.segments",
    needs_map=False,
    see_also=("self_calibrate", "segment_database_stats"),
    reads=("database",),
)
def suggest_motion(
    context: CommandContext,
    *,
    database: Path,
    suggestions: int = 3,
    wanted: WantedSigmas = WantedSigmas(),
    options: SelfCalibrationOptions = SelfCalibrationOptions(),
    size: SizeOptions = SizeOptions(),
) -> SuggestionReport:
    """Suggest the motions that would teach most about a device, by what its segments leave unknown.

    Motions of one segment each are simulated with the sensors of the database; each suggestion follows
    on those before. An open viewer shows the first as an arrow, and how much is known as a bar.

    Args:
        suggestions: Number of motions.
    """
    from maplab_plugins.visualization.following import open_viewer
    from maplab_py.algorithms.self_calibration.segments.database import load_database
    from maplab_py.online_calibration.suggestions import suggest_motion as suggest

    if suggestions < 1:
        raise UserError(f"--suggestions={suggestions}: must be 1 or more")
    report = suggest(
        load_database(database, size.max_bytes),
        options,
        wanted,
        count=suggestions,
        progress=context.progress,
    )
    if (viewer := open_viewer(context)) is not None:
        motion = "" if report.sufficient else report.suggestions[0].motion
        viewer.motion.show(motion, report.known_share)
    return report


@command(
    "export_segments",
    example="export_segments --database=device.segments --map_folder=segments",
    needs_map=False,
    guards_effects=True,
)
def export_segments(
    context: CommandContext,
    *,
    database: Path,
    map_folder: Path,
    overwrite: bool = False,
    size: SizeOptions = SizeOptions(),
) -> Message:
    """Write the segments of a database as a map that can be loaded, looked at and optimised.

    Args:
        map_folder: Destination folder.
        overwrite: Replace a map that is there.
    """
    from maplab_py.algorithms.self_calibration.segments.database import load_database
    from maplab_py.storage.native import save_map

    segments = load_database(database, size.max_bytes)
    save_map(segments.vi_map, map_folder, overwrite=overwrite, progress=context.progress)
    missions = counted(len(segments.vi_map.missions), "mission")
    return Message(f"wrote {counted(len(segments), 'segment')} of {missions} to {map_folder}")


@command(
    "evaluate_segment_information",
    example="evaluate_segment_information --plot=information.svg",
    see_also=("collect_segments",),
    writes_files=True,
)
def evaluate_segment_information(
    context: CommandContext,
    *,
    options: SelfCalibrationOptions = SelfCalibrationOptions(),
    group: Literal["imu", "camera", "extrinsics"] = "imu",
    plot: Path | None = None,
    csv: Path | None = None,
    chosen: MissionChoice = ALL_MISSIONS,
    overwrite: bool = False,
) -> reports.InformationReport:
    """Show the information of every segment for each group of parameters; smaller is better.

    Args:
        group: Group that the plot and the file show.
        plot: Write the trajectory from above, coloured by information, to this SVG file.
        csv: Write segments with their information to this file, which the viewer reads.
    """
    from maplab_py.algorithms.self_calibration import drawing
    from maplab_py.algorithms.self_calibration.segments.selection import segment_information

    check_writable(plot, csv, overwrite=overwrite)
    report, segments = segment_information(
        context.vi_map,
        options,
        missions=chosen.rows(context.vi_map),
        progress=context.progress,
    )
    scores = [float(getattr(segment, group)) for segment in report.segments]
    if plot is not None:
        title = f"information about {group} ({options.metric.replace('_', '-')})"
        picture = drawing.draw(context.vi_map, segments, scores, title)
        write_text(plot, [picture], overwrite=overwrite)
    if csv is not None:
        rows = [(segment.mission, segment.start_ns, segment.end_ns) for segment in report.segments]
        write_text(csv, [drawing.as_csv(rows, scores)], overwrite=overwrite)
    return report


@command(
    "apply_calibration",
    example="apply_calibration --calibration=sensors.yaml",
    see_also=("compare_calibrations", "export_calibration"),
    reads=("calibration",),
)
def apply_calibration(
    context: CommandContext,
    *,
    calibration: Path,
    chosen: MissionChoice = ALL_MISSIONS,
    size: SizeOptions = SizeOptions(),
) -> reports.CalibrationComparison:
    """Apply the calibration of a sensors.yaml or of another map to the device; poses are unchanged.

    Args:
        calibration: sensors.yaml, map folder, or segment database.
    """
    from maplab_py.algorithms.self_calibration.comparison import compare
    from maplab_py.algorithms.self_calibration.device import device_of, transfer_calibration
    from maplab_py.algorithms.self_calibration.segments.database import read_calibration

    missions = chosen.rows(context.vi_map)
    before = context.vi_map
    after = transfer_calibration(
        before, read_calibration(calibration, size.max_bytes), missions=missions
    )
    context.commit(after)
    device = device_of(before, missions)
    return compare(before.sensors, device, after.sensors, device)


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
    chosen: MissionChoice = ALL_MISSIONS,
    overwrite: bool = False,
) -> ExportedFiles:
    """Write the calibration of the map's device for maplab, kalibr, OpenVINS or Basalt.

    Args:
        folder: Destination folder; created if missing.
        format: File format.
    """
    from maplab_py.algorithms.self_calibration.device import device_of, imu_rate_hz
    from maplab_py.interop.calibration_export import exported

    vi_map = context.vi_map
    device = device_of(vi_map, chosen.rows(context.vi_map))
    contents = exported(vi_map.sensors, *device, format, imu_rate_hz=imu_rate_hz(vi_map))
    check_writable(*(folder / name for name in contents), overwrite=overwrite)
    for name, text in contents.items():
        write_text(folder / name, [text], overwrite=overwrite)
    return ExportedFiles(tuple(folder / name for name in contents))


@command(
    "compare_calibrations",
    example="compare_calibrations --calibration=sensors.yaml",
    see_also=("apply_calibration",),
    reads=("calibration",),
)
def compare_calibrations(
    context: CommandContext,
    *,
    calibration: Path,
    chosen: MissionChoice = ALL_MISSIONS,
    size: SizeOptions = SizeOptions(),
) -> reports.CalibrationComparison:
    """Compare the calibration of the map's device with another, parameter by parameter.

    Args:
        calibration: sensors.yaml, map folder, or segment database.
    """
    from maplab_py.algorithms.self_calibration.comparison import compare
    from maplab_py.algorithms.self_calibration.device import device_of
    from maplab_py.algorithms.self_calibration.segments.database import read_calibration
    from maplab_py.sensors.calibration_transfer import corresponding_device

    sensors, other = context.vi_map.sensors, read_calibration(calibration, size.max_bytes)
    device = device_of(context.vi_map, chosen.rows(context.vi_map))
    return compare(sensors, device, other, corresponding_device(other, device))


def _existing(path: Path | None, size: SizeOptions) -> SegmentDatabase | None:
    from maplab_py.algorithms.self_calibration.segments.database import load_database

    if path is None or not path.exists():
        return None
    return load_database(path, size.max_bytes)
