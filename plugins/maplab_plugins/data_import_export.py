"""Commands that write parts of a map for other tools."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from maplab_py.interop.csv_dataset import CsvExportOptions, CsvExportReport
from maplab_py.plugin import CommandContext, Report, UserError, command

if TYPE_CHECKING:
    from maplab_py.vision.projection import DescriptorProjection

_ONLY_VERTICES = CsvExportOptions(
    imu_data=False,
    tracks_and_keypoints=False,
    descriptors=False,
    landmarks=False,
    observations=False,
)


class WrittenFiles(Report):
    """Files that a command has written."""

    files: tuple[Path, ...]
    rows: int


@command("csv_export", example="csv_export --csv_export_path=csv", writes_files=True)
def csv_export(
    context: CommandContext,
    csv_export_path: Path,
    *,
    options: CsvExportOptions = CsvExportOptions(),
    export_projected_descriptor: bool = False,
    lc_projection_matrix_filename: str = "",
    map_mission: str = "",
    overwrite: bool = False,
) -> CsvExportReport:
    """Write vertices, IMU data, tracks, descriptors, landmarks and observations as CSV files.

    Args:
        csv_export_path: Folder to write into; it gets one folder per mission.
        export_projected_descriptor: Write to descriptors.csv the real numbers that loop closure
            compares, in place of the bytes of the descriptors.
        lc_projection_matrix_filename: Projection that train_projection_matrix wrote, for
            --export_projected_descriptor; empty, or of another length of descriptors = learned from
            the tracks of the exported missions, as loop closure among them does.
        map_mission: Mission id or unambiguous prefix; empty = all missions.
    """
    if lc_projection_matrix_filename and not export_projected_descriptor:
        raise UserError(
            "csv_export: --lc_projection_matrix_filename needs --export_projected_descriptor"
        )
    projection = None
    if export_projected_descriptor:
        if not options.descriptors:
            raise UserError(
                "csv_export: --export_projected_descriptor needs --csv_export_descriptors"
            )
        projection = _projection(context, map_mission, lc_projection_matrix_filename)
    return _export_csv(context, csv_export_path, options, map_mission, overwrite, projection)


def _projection(context: CommandContext, map_mission: str, file: str) -> DescriptorProjection:
    """Return the projection of descriptors that loop closure among the chosen missions uses."""
    from maplab_py.algorithms.loop_closure.features import map_features
    from maplab_py.vision.projection import load_projection

    rows = context.mission_rows(map_mission)
    missions = np.arange(len(context.vi_map.missions)) if rows is None else rows
    given = load_projection(Path(file)) if file else None
    return map_features(context.vi_map, missions, projection=given)[1]


@command(
    "csv_export_vertices_only",
    example="csv_export_vertices_only --csv_export_path=csv",
    writes_files=True,
)
def csv_export_vertices_only(
    context: CommandContext,
    csv_export_path: Path,
    *,
    export_absolute_time: bool = False,
    map_mission: str = "",
    overwrite: bool = False,
) -> CsvExportReport:
    """Write the vertices of each mission as a CSV file.

    Args:
        csv_export_path: Folder to write into; it gets one folder per mission.
        export_absolute_time: Write time stamps as they are; else relative to the first vertex.
        map_mission: Mission id or unambiguous prefix; empty = all missions.
    """
    options = dataclasses.replace(_ONLY_VERTICES, absolute_time=export_absolute_time)
    return _export_csv(context, csv_export_path, options, map_mission, overwrite)


def _export_csv(
    context: CommandContext,
    folder: Path,
    options: CsvExportOptions,
    map_mission: str,
    overwrite: bool,
    projection: DescriptorProjection | None = None,
) -> CsvExportReport:
    from maplab_py.interop.csv_dataset import export_csv_dataset

    return export_csv_dataset(
        context.vi_map,
        folder,
        options,
        missions=context.mission_rows(map_mission),
        projector=projection,
        overwrite=overwrite,
        progress=context.progress,
    )


@command(
    "export_trajectory_to_csv",
    "ettc",
    example="ettc --pose_export_file=poses.csv",
    writes_files=True,
)
def export_trajectory_to_csv(
    context: CommandContext,
    *,
    pose_export_file: Path | None = None,
    csv_export_format: Literal["asl", "rpg", "tum"] = "asl",
    pose_export_reference_sensor_id: str = "",
    interpolate_to_imu_timestamps: bool = False,
    map_mission: str = "",
    overwrite: bool = False,
) -> WrittenFiles:
    """Write poses, velocities and biases of the vertices to a file.

    Args:
        pose_export_file: File to write; by default a file in the map's folder.
        csv_export_format: asl = comma-separated poses in G and M, velocities and biases;
            rpg or tum = TUM, poses in G only.
        pose_export_reference_sensor_id: Sensor or camera whose poses are written; empty = IMU.
        interpolate_to_imu_timestamps: Write a state at every IMU sample, not only at vertices.
        map_mission: Mission id or unambiguous prefix; empty = all missions.
    """
    from maplab_py.interop import vertex_states as states_io

    path = pose_export_file
    if path is None:
        if context.map_folder is None:
            raise UserError("the map has no folder yet: give --pose_export_file=FILE")
        is_asl = csv_export_format == "asl"
        path = context.map_folder / (states_io.ASL_FILE if is_asl else states_io.RPG_FILE)
    states = states_io.vertex_states(
        context.vi_map,
        missions=context.mission_rows(map_mission),
        reference_sensor_id=pose_export_reference_sensor_id,
        at_imu_times=interpolate_to_imu_timestamps,
    )
    if csv_export_format == "asl":
        states_io.write_asl(context.vi_map, states, path, overwrite=overwrite)
    else:
        states_io.write_rpg(states, path, overwrite=overwrite)
    return WrittenFiles((path,), len(states))


@command(
    "export_ncamera_calibration",
    "encc",
    example="encc --ncamera_calibration_export_folder=c",
    writes_files=True,
)
def export_ncamera_calibration(
    context: CommandContext,
    ncamera_calibration_export_folder: Path,
    *,
    overwrite: bool = False,
) -> WrittenFiles:
    """Write the calibration of each camera rig of the map to a YAML file.

    Args:
        ncamera_calibration_export_folder: Folder to write into; files are named by sensor id.
    """
    from maplab_py.output_files import check_writable, write_text
    from maplab_py.sensors import CameraRig, sensors_yaml, yaml_text

    folder = ncamera_calibration_export_folder
    rigs = [s for s in context.vi_map.sensors.sensors.values() if isinstance(s, CameraRig)]
    if not rigs:
        raise UserError("the map has no camera rig whose calibration could be written")
    paths = tuple(folder / f"ncamera-{rig.id}.yaml" for rig in rigs)
    check_writable(*paths, overwrite=overwrite)
    for path, rig in zip(paths, rigs, strict=True):
        write_text(path, [yaml_text.dump_yaml(sensors_yaml.sensor_entry(rig))], overwrite=overwrite)
    return WrittenFiles(paths, len(paths))


@command(
    "export_mission_info",
    example="export_mission_info --mission_info_export_path=info.yaml",
    writes_files=True,
)
def export_mission_info(
    context: CommandContext,
    mission_info_export_path: Path,
    *,
    overwrite: bool = False,
) -> WrittenFiles:
    """Write a YAML file that lists the mission ids of every map in memory.

    Args:
        mission_info_export_path: File to write.
    """
    from maplab_py.output_files import write_text
    from maplab_py.sensors.yaml_text import dump_yaml
    from maplab_py.vimap import ids

    path = mission_info_export_path
    info = {entry.key: ids.to_hex_list(entry.vi_map.missions.id) for entry in context.maps}
    write_text(path, [dump_yaml(info)], overwrite=overwrite)
    return WrittenFiles((path,), sum(len(missions) for missions in info.values()))
