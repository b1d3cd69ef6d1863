"""The content of maps, their memory, and the reasons of refused closures and landmarks."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.anchoring.options import AnchoringOptions
from maplab_py.algorithms.landmarks.options import LandmarkQualityOptions
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.console.session.maps import UndoOptions
from maplab_py.plugin import ALL_MISSIONS, CommandContext, MissionChoice, Report, UserError, command
from maplab_py.vimap.ids import to_hex_list

if TYPE_CHECKING:
    from maplab_py.algorithms.landmarks.quality import LandmarkExplanation
    from maplab_py.algorithms.loop_closure.explanation import (
        ClosureExplanation,
        MissionExplanation,
        PairExplanation,
    )
    from maplab_py.algorithms.map_health import MapHealth
    from maplab_py.console.session.session import Session
    from maplab_py.vimap import VIMap, consistency
    from maplab_py.vimap.ids import IdArray
    from maplab_py.vimap.statistics import CoobservabilityReport, MapDetails, MapStatistics


@dataclasses.dataclass(frozen=True)
class BaseFrameLine:
    """The base frame of one mission."""

    mission: str
    is_known: bool
    p_G_M: NDArray[np.float64] = dataclasses.field(metadata={"unit": "m"})
    q_G_M_xyzw: NDArray[np.float64]
    yaw_deg: float


class BaseFrameList(Report):
    """The base frames of all missions."""

    baseframes: tuple[BaseFrameLine, ...]


@dataclasses.dataclass(frozen=True)
class CameraLine:
    """The calibration of one camera."""

    rig: str
    camera: int
    projection: str
    intrinsics: NDArray[np.float64]
    distortion: str
    distortion_parameters: NDArray[np.float64]
    size_px: str
    p_B_C: NDArray[np.float64] = dataclasses.field(metadata={"unit": "m"})
    q_B_C_xyzw: NDArray[np.float64]


class CameraList(Report):
    """The calibrations of all cameras."""

    cameras: tuple[CameraLine, ...]


@command("map_stats", "ms", see_also=("statistics", "map_size"))
def map_stats(
    context: CommandContext, *, chosen: MissionChoice = ALL_MISSIONS
) -> MapStatistics | MapDetails:
    """Show one row per mission; all counts of a mission if one is given.

    `good`, `bad` and `unknown` are the landmarks stored in the mission, `closures` the recorded loop
    closures that were accepted; `known` says whether the base frame T_G_M is known.
    """
    from maplab_py.algorithms.loop_closure.listing import accepted_by_mission
    from maplab_py.vimap.statistics import MapDetails, map_statistics

    vi_map = context.vi_map
    rows = chosen.rows(vi_map)
    report = map_statistics(vi_map)
    missions = [
        dataclasses.replace(mission, closures=int(count))
        for mission, count in zip(report.missions, accepted_by_mission(vi_map), strict=True)
    ]
    if rows is None:
        return dataclasses.replace(report, missions=tuple(missions))
    return MapDetails(tuple(missions[row] for row in rows), None, report.memory_megabytes)


@command("mission_coobservability_stats", "mcs")
def mission_coobservability_stats(context: CommandContext) -> CoobservabilityReport:
    """Show which missions share landmarks."""
    from maplab_py.vimap.statistics import coobservability

    return coobservability(context.vi_map)


@command("print_baseframes")
def print_baseframes(context: CommandContext) -> BaseFrameList:
    """Print the base frame T_G_M of every mission and whether it is known."""
    vi_map = context.vi_map
    if not len(vi_map.missions):
        raise UserError(f"print_baseframes: map '{context.map_key}' has no missions")
    T_G_M = vi_map.T_G_M
    x, y, z, w = T_G_M[:, :4].T
    yaw_deg = np.degrees(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
    known = vi_map.baseframes.is_known[vi_map.missions.baseframe]
    ids = to_hex_list(vi_map.missions.id)
    return BaseFrameList(
        tuple(
            BaseFrameLine(ids[row], bool(known[row]), pose[4:], pose[:4], float(yaw_deg[row]))
            for row, pose in enumerate(T_G_M)
        )
    )


@command("print_camera_calibrations")
def print_camera_calibrations(context: CommandContext) -> CameraList:
    """Print intrinsics, distortion and mounting of every camera."""
    from maplab_py.sensors import CameraRig

    lines = []
    for sensor in context.vi_map.sensors.sensors.values():
        if not isinstance(sensor, CameraRig):
            continue
        for index, (camera, T_B_C) in enumerate(zip(sensor.cameras, sensor.T_B_C, strict=True)):
            lines.append(
                CameraLine(
                    sensor.id,
                    index,
                    camera.projection.value,
                    camera.intrinsics,
                    camera.distortion.value,
                    camera.distortion_parameters,
                    f"{camera.width_px} x {camera.height_px}",
                    T_B_C[4:],
                    T_B_C[:4],
                )
            )
    if not lines:
        raise UserError(f"print_camera_calibrations: map '{context.map_key}' has no cameras")
    return CameraList(tuple(lines))


@command("check_map_consistency")
def check_map_consistency(context: CommandContext) -> consistency.ConsistencyReport:
    """Check the consistency of the map; fails if a rule is violated.

    Resources whose files are missing are errors. Files in the map's resource folder that no resource
    refers to are warnings; `clean_up_resource_folders` deletes them. A map whose lengths contradict its
    accelerometer has a warning, too.
    """
    from maplab_py.algorithms.scale_check import scale_doubts
    from maplab_py.storage.resources.files import with_file_checks
    from maplab_py.vimap.consistency import Violation, check_consistency

    report = check_consistency(context.vi_map)
    if not report.errors:
        doubts = tuple(Violation(doubt, 1, ()) for doubt in scale_doubts(context.vi_map))
        report = dataclasses.replace(report, warnings=(*report.warnings, *doubts))
    return with_file_checks(report, context.vi_map, context.map_folder)


@command(
    "doctor",
    example="doctor --file=health.html",
    see_also=("check_recording", "check_map_consistency", "why"),
    writes_files=True,
)
def doctor(
    context: CommandContext, *, file: Path | None = None, overwrite: bool = False
) -> MapHealth:
    """Judge the health of the map on one page: lights with figures, and the command that mends each.

    Consistency, the calibration against tracks and samples, scale, biases, landmarks, coverage, drift before
    loop closures, ambiguous places, base frames and disk. Causes come before effects: mend the first.

    Args:
        file: Write the page here, as HTML or JSON by its ending.
    """
    from maplab_py.algorithms.map_health import map_health
    from maplab_py.output_files import check_writable, write_text

    if file is not None:
        if file.suffix not in (".html", ".json"):
            raise UserError(f"--file={file}: give a name that ends in .html or .json")
        check_writable(file, overwrite=overwrite)
    health = map_health(context.vi_map, context.map_key, context.map_folder, context.progress)
    if file is not None:
        text = health.as_html() if file.suffix == ".html" else health.as_json(indent=2)
        write_text(file, [text], overwrite=overwrite)
    return health


_GB = 1e-9


@dataclasses.dataclass(frozen=True)
class MapMemory:
    """Memory of one map."""

    map_key: str
    columns_gb: float
    mapped_gb: float  # part of the columns that lies in a file of the cache
    undo_values: int
    undo_gb: float  # of former values and snapshots, what the present value shares left out
    dropped_values: int  # that undo cannot restore any more


class MemoryReport(Report):
    """Memory of the maps, the cache of maps and the process."""

    maps: tuple[MapMemory, ...] = dataclasses.field(metadata={"title": ""})
    undo_max_gb: float
    cached_maps: int
    cache_gb: float
    cache_folder: str
    process_gb: float
    available_gb: float


@command(
    "memory",
    see_also=("list", "undo", "clear_storage", "resource_cache_statistics"),
    needs_map=False,
)
def memory(context: CommandContext, *, undo: UndoOptions = UndoOptions()) -> MemoryReport:
    """Show the memory of maps, of undo and of the cache of maps; limit that of undo.

    A column that several maps or former values share counts once, for the first of them. Columns in a
    file of the cache of maps take memory only where they are in use, and the system takes that back
    when it is short.

    A limit that is given holds for the rest of the session.
    """
    from maplab_py.console.session.maps import bounded, former_values
    from maplab_py.console.session.settings import Layer
    from maplab_py.memory import available_bytes, resident_bytes
    from maplab_py.storage.cache import column_file, map_cache
    from maplab_py.vimap.memory_use import SharedColumns

    settings = context.session.settings
    if undo != UndoOptions.of(settings) and not context.is_trial:
        settings.assign([f"--undo_max_gb={undo.undo_max_gb!r}"], Layer.SET, "memory")
    columns, mapped, lines = SharedColumns(), SharedColumns(), []
    for entry in context.maps:
        kept = bounded(entry, undo)
        context.maps.update(kept)
        values = former_values(kept)
        lines.append(
            MapMemory(
                map_key=kept.key,
                columns_gb=_GB * columns.add(kept.vi_map),
                mapped_gb=_GB * mapped.add(kept.vi_map, column_file.mapped_bytes),
                undo_values=len(values),
                undo_gb=_GB * columns.add_all(values),
                dropped_values=kept.dropped_values,
            )
        )
    cache = map_cache.MapCache()
    use = cache.use()
    return MemoryReport(
        maps=tuple(lines),
        undo_max_gb=undo.undo_max_gb,
        cached_maps=use.maps,
        cache_gb=_GB * use.bytes,
        cache_folder=str(cache.folder),
        process_gb=_GB * resident_bytes(),
        available_gb=_GB * available_bytes(),
    )


def subjects(session: Session) -> list[tuple[str, str]]:
    """Return what can be asked about: the missions, then the recorded closures."""
    from maplab_py.algorithms.loop_closure.closure_record import described_ids
    from maplab_py.vimap.queries import mission_labels

    missions = [(label, "mission") for label in mission_labels(session.vi_map)]
    return missions + described_ids(session.vi_map)


@command(
    "why",
    example="why 59f0",
    see_also=("lc_report", "anchor_all_missions", "evaluate_landmark_quality"),
    completes={"subject": subjects, "other": "mission"},
)
def why(
    context: CommandContext,
    subject: str,
    other: str = "",
    *,
    loop_options: LoopClosureOptions = LoopClosureOptions(),
    anchoring: AnchoringOptions = AnchoringOptions(),
    quality: LandmarkQualityOptions = LandmarkQualityOptions(),
) -> ClosureExplanation | PairExplanation | MissionExplanation | LandmarkExplanation:
    """Explain a closure, a pair of missions, a mission or a landmark: every gate with its value.

    Each gate is shown with its threshold, whether it was passed, and the flag that moves it. Flags
    given here, or with `set`, show what would be decided with them.

    Args:
        subject: Beginning of the id of a closure or landmark, or a mission by name or id.
        other: Second mission: explain which gates the closures between the two missions fail.
    """
    from maplab_py.algorithms.landmarks.quality import explain_landmark
    from maplab_py.algorithms.loop_closure import explanation

    vi_map = context.vi_map
    if other:
        first, second = context.mission_row(subject), context.mission_row(other)
        if first == second:
            raise UserError("why: name two different missions")
        return explanation.explain_pair(
            vi_map, first, second, loop_options, anchoring.min_inlier_count, context.progress
        )
    kind, row = _resolve(vi_map, subject)
    if kind == "mission":
        return explanation.explain_mission(vi_map, row)
    if kind == "closure":
        return explanation.explain_closure(vi_map, row, loop_options)
    return explain_landmark(vi_map, row, quality)


def _resolve(vi_map: VIMap, subject: str) -> tuple[str, int]:
    """Return what a text names, and its row: a mission's name first, then the beginning of an id.

    Raises:
        UserError: It names nothing, or several things.
    """
    from maplab_py.algorithms.loop_closure.closure_record import read_record

    names = [str(name) for name in vi_map.missions.name]
    if subject in names and names.count(subject) == 1:
        return "mission", names.index(subject)
    prefix = subject.strip().lower()
    closures = read_record(vi_map).closures.id
    matches = _beginning(prefix, ("mission", vi_map.missions.id), ("closure", closures))
    matches = matches or _beginning(prefix, ("landmark", vi_map.landmarks.id))
    if not matches:
        matches = [
            ("mission", row, name)
            for row, name in enumerate(names)
            if prefix and name.lower().startswith(prefix)
        ]
    if len(matches) == 1:
        return matches[0][0], matches[0][1]
    if not matches:
        raise UserError(
            f"why: no closure, mission or landmark begins with '{subject}' "
            "(lc_report lists closures, map_stats missions)"
        )
    shown = ", ".join(f"{kind} {name[:12]}" for kind, _, name in matches[:4])
    raise UserError(
        f"why: '{subject}' is ambiguous: several ids begin with it ({shown}); give more digits"
    )


def _beginning(prefix: str, *ids: tuple[str, IdArray]) -> list[tuple[str, int, str]]:
    """Return kind, row and id of everything whose id begins with a prefix."""
    from maplab_py.vimap.ids import to_hex_list

    return [
        (kind, row, id_)
        for kind, words in ids
        for row, id_ in enumerate(to_hex_list(words))
        if prefix and id_.startswith(prefix)
    ]
