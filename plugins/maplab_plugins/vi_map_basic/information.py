"""Content and consistency of the selected map."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from maplab_py.plugin import (
    ALL_MISSIONS,
    CommandContext,
    MissionChoice,
    Report,
    UserError,
    command,
)
from maplab_py.vimap.ids import to_hex_list

if TYPE_CHECKING:
    from maplab_py.vimap.consistency import ConsistencyReport
    from maplab_py.vimap.statistics import CoobservabilityReport, MapDetails, MapStatistics


@dataclasses.dataclass(frozen=True)
class BaseFrameLine:
    """The base frame of one mission."""

    mission: str
    is_known: bool
    p_G_M: NDArray[np.float64] = dataclasses.field(metadata={"unit": "m"})
    q_G_M_xyzw: NDArray[np.float64]
    yaw_deg: float


@dataclasses.dataclass(frozen=True)
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


@dataclasses.dataclass(frozen=True)
class CameraList(Report):
    """The calibrations of all cameras."""

    cameras: tuple[CameraLine, ...]


@command("map_stats", "ms", example="map_stats", see_also=("statistics", "map_size"))
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
def check_map_consistency(context: CommandContext) -> ConsistencyReport:
    """Check the consistency of the map; fails if a rule is violated.

    Resources whose files are missing are errors. Files in the map's resource folder that no resource
    refers to are warnings; `clean_up_resource_folders` deletes them. A map whose lengths contradict its
    accelerometer has a warning, too.
    """
    from maplab_py.algorithms.scale_check import scale_doubts
    from maplab_py.storage.resource_files import with_file_checks
    from maplab_py.vimap.consistency import Violation, check_consistency

    report = check_consistency(context.vi_map)
    if not report.errors:
        doubts = tuple(Violation(doubt, 1, ()) for doubt in scale_doubts(context.vi_map))
        report = dataclasses.replace(report, warnings=(*report.warnings, *doubts))
    return with_file_checks(report, context.vi_map, context.map_folder)
