"""Commands that read calibrations, trajectories and positions of other programs."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from maplab_py.algorithms.external_poses import options as poses
from maplab_py.interop.device import DeviceOptions
from maplab_py.plugin import (
    ALL_MISSIONS,
    CommandContext,
    MissionChoice,
    Report,
    command,
    write_text,
)
from maplab_py.report import view

if TYPE_CHECKING:
    from maplab_py.algorithms.self_calibration.reports import ComparedParameter
    from maplab_py.interop.calibration_import import CalibrationFile
    from maplab_py.interop.trajectories import Trajectory
    from maplab_py.sensors import Imu

_TRAJECTORY, _GPS, _WHEELS = poses.TrajectoryOptions(), poses.GpsOptions(), poses.WheelOptions()


@dataclasses.dataclass(frozen=True)
class ReadCamera:
    """A camera of a calibration file."""

    projection: str
    distortion: str
    width_px: int
    height_px: int
    time_shift_s: float  # t_imu - t_camera
    line_delay_ns: int  # 0 = global shutter


@dataclasses.dataclass(frozen=True)
class ReadParameter:
    """A number of a calibration file."""

    parameter: str
    unit: str
    value: float


class CalibrationImport(Report):
    """Contents of a calibration file, and their use."""

    file: Path
    format: str
    cameras: tuple[ReadCamera, ...]
    has_imu: bool
    has_imu_intrinsics: bool
    parameters: tuple[ReadParameter, ...] = ()  # poses are on the IMU, else on the first camera
    notes: tuple[str, ...] = ()  # what was not understood, contradicts, or is odd
    sensors_file: Path | None = None  # that was written
    changes: tuple[ComparedParameter, ...] = ()  # of the map's device

    def display(self) -> Any:
        """Return the report with six digits of numbers, and without what the changes say, too."""
        rows = () if self.changes else self.parameters
        numbers = [
            view(parameter=row.parameter, value=f"{row.value + 0.0:.6g}", unit=row.unit)
            for row in rows
        ]
        return view(**vars(self) | {"parameters": numbers})

    @property
    def advice(self) -> str:
        """Say what can be done with a file that was only looked at."""
        if self.sensors_file is not None or self.changes:
            return ""
        return "--sensors_file=sensors.yaml writes it for maplab, --apply gives it to the map"


@command(
    "import_calibration",
    example="import_calibration kalibr/camchain-imucam.yaml --imu_calibration_file=kalibr/imu.yaml --apply",
    see_also=("export_calibration", "apply_calibration", "recording_info"),
    needs_map=False,
    writes_files=True,
    reads=("calibration_file",),
)
def import_calibration(
    context: CommandContext,
    calibration_file: Path,
    *,
    imu_calibration_file: Path | None = None,
    device: DeviceOptions = DeviceOptions(),
    sensors_file: Path | None = None,
    apply: bool = False,
    apply_imu_noise: bool = True,
    chosen: MissionChoice = ALL_MISSIONS,
    overwrite: bool = False,
) -> CalibrationImport:
    """Read a calibration of another program, for sensors.yaml or for the map.

    The format follows from the content: kalibr, EuRoC, OpenVINS, Basalt, COLMAP, VINS-Mono and VINS-Fusion,
    ORB-SLAM, stella_vslam, Kimera, OKVIS, SVO, DM-VIO, ROS' CameraInfo, OpenCV, RealSense, maplab. In a map
    poses and stamps are unchanged: a time shift that differs from that of the recording becomes an image
    delay.

    Args:
        calibration_file: File with cameras, an IMU or both; or the folder of an EuRoC recording, of OpenVINS'
            or Kimera's parameters, or of a COLMAP model of one rig.
        imu_calibration_file: File of the IMU, where the other has cameras alone, as kalibr's camera chain.
        sensors_file: Write sensors.yaml for maplab here.
        apply: Give the calibration to the device of the map.
        apply_imu_noise: With --apply, take over the noise densities of the IMU, too.
    """
    from maplab_py.interop.calibration_import import import_calibration as read
    from maplab_py.sensors.sensors_yaml import write_sensors

    calibration = read(calibration_file, imu_calibration_file, device)
    changes: tuple[ComparedParameter, ...] = ()
    if apply:
        changes = _apply(context, calibration, chosen, imu_noise=apply_imu_noise)
    if sensors_file is not None:
        write_text(sensors_file, [write_sensors(calibration.sensors)], overwrite=overwrite)
    return _describe(calibration, sensors_file, changes)


def _apply(
    context: CommandContext, calibration: CalibrationFile, chosen: MissionChoice, *, imu_noise: bool
) -> tuple[ComparedParameter, ...]:
    from maplab_py.algorithms.self_calibration.comparison import compare
    from maplab_py.algorithms.self_calibration.device import device_of, with_calibration_file

    before = context.vi_map
    missions = chosen.rows(before)
    after = with_calibration_file(before, calibration, missions=missions, imu_noise=imu_noise)
    device = device_of(before, missions)
    context.commit(after)
    return compare(before.sensors, device, after.sensors, device).parameters


def _describe(
    calibration: CalibrationFile, written: Path | None, changes: tuple[ComparedParameter, ...]
) -> CalibrationImport:
    sensors = calibration.sensors
    cameras = sensors.camera_rig(calibration.rig_id).cameras if calibration.rig_id else ()
    imu = sensors.imu(calibration.imu_id) if calibration.imu_id else None
    return CalibrationImport(
        file=calibration.source,
        format=calibration.format,
        cameras=tuple(
            ReadCamera(
                camera.projection.value,
                camera.distortion.value,
                camera.width_px,
                camera.height_px,
                camera.time_offset_ns * 1e-9 + camera.image_delay_s,
                camera.line_delay_ns,
            )
            for camera in cameras
        ),
        has_imu=imu is not None,
        has_imu_intrinsics=imu is not None and imu.intrinsics is not None,
        parameters=(*_camera_parameters(calibration), *_imu_parameters(imu)),
        notes=calibration.notes,
        sensors_file=written,
        changes=changes,
    )


def _camera_parameters(calibration: CalibrationFile) -> Iterator[ReadParameter]:
    import numpy as np

    from maplab_py.geometry import so3
    from maplab_py.sensors.camera import parameter_names

    if not calibration.rig_id:
        return
    for row, (camera, T) in enumerate(zip(calibration.cameras, calibration.T_I_C, strict=True)):
        names = parameter_names(camera.projection, camera.distortion)
        values = [*camera.intrinsics, *camera.distortion_parameters]
        names += [(f"position {axis}", "m") for axis in "xyz"]
        names += [(f"rotation about {axis}", "deg") for axis in "xyz"]
        values += [*T[4:], *np.degrees(so3.log(T[:4]))]
        for (name, unit), value in zip(names, values, strict=True):
            yield ReadParameter(f"camera {row} {name}", unit, float(value))


def _imu_parameters(imu: Imu | None) -> Iterator[ReadParameter]:
    from maplab_py.sensors.imu import TRIANGLE_NAMES

    if imu is None:
        return
    for name, unit, value in (
        ("accelerometer noise", "m/s²/√Hz", imu.acc_noise_density),
        ("accelerometer random walk", "m/s³/√Hz", imu.acc_bias_random_walk_noise_density),
        ("gyroscope noise", "rad/s/√Hz", imu.gyro_noise_density),
        ("gyroscope random walk", "rad/s²/√Hz", imu.gyro_bias_random_walk_noise_density),
        ("gravity", "m/s²", imu.gravity_magnitude_mps2),
    ):
        yield ReadParameter(name, unit, value)
    if imu.intrinsics is None:
        return
    for sensor, T in (("gyroscope", imu.intrinsics.T_g), ("accelerometer", imu.intrinsics.T_a)):
        for name, place in TRIANGLE_NAMES.items():
            yield ReadParameter(f"{sensor} {name}", "", float(T[place]))


@command(
    "import_trajectory",
    example="import_trajectory poses.csv --as=absolute --map_mission=59f0",
    see_also=("export_trajectory_to_csv", "evaluate_trajectory", "optimize_visual_inertial"),
    needs_map=False,
    reads=("trajectory_file",),
)
def import_trajectory(
    context: CommandContext,
    trajectory_file: Path,
    *,
    options: poses.TrajectoryOptions = _TRAJECTORY,
    map_mission: str = "",
    map_key: str = "",
) -> poses.TrajectoryImport:
    """Read a trajectory as absolute poses or odometry edges of a mission, or as a new mission.

    TUM, EuRoC and CSV with named columns are told apart by their content; KITTI needs --times_file.
    Positions are in metres, and z of the trajectory's frame points upwards.

    Args:
        trajectory_file: File with the trajectory.
        map_key: With --as=mission: name of a new map; empty = add the mission to the selected map, or to a
            new map of the file's name if there is none.
    """
    from maplab_py.algorithms.external_poses.trajectories import shifted
    from maplab_py.interop.trajectories import read_kitti, read_trajectory

    if options.times_file is None:
        trajectory = read_trajectory(trajectory_file, options.time_unit, needs_orientation=False)
    else:
        trajectory = read_kitti(trajectory_file, options.times_file, options.time_unit)
    if trajectory.note:
        context.terminal.note(trajectory.note)
    trajectory = shifted(trajectory, options.time_offset_s)
    if options.kind == "mission":
        return _new_mission(context, trajectory, options, map_key)
    return _measurements(context, trajectory, options, context.mission_row(map_mission))


def _measurements(
    context: CommandContext, trajectory: Trajectory, options: poses.TrajectoryOptions, mission: int
) -> poses.TrajectoryImport:
    from maplab_py.algorithms.external_poses import trajectories

    is_absolute = options.kind == "absolute"
    attach = trajectories.as_absolute_poses if is_absolute else trajectories.as_odometry
    result, report = attach(context.vi_map, mission, trajectory, options)
    context.commit(result)
    return report


def _new_mission(
    context: CommandContext, trajectory: Trajectory, options: poses.TrajectoryOptions, map_key: str
) -> poses.TrajectoryImport:
    from maplab_py.algorithms.external_poses.trajectories import as_mission
    from maplab_py.vimap import ids, merge

    vi_map = as_mission(trajectory, options)
    if map_key or not context.maps.selected_key:
        context.maps.add(map_key or Path(trajectory.source).stem, vi_map)
    else:
        context.commit(merge.merge_maps(context.vi_map, vi_map)[0])
    return poses.TrajectoryImport(
        file=Path(trajectory.source),
        kind="mission",
        mission=ids.to_hex(vi_map.missions.id[0])[:8],
        poses_in_file=len(trajectory),
        added=len(vi_map.vertices),
    )


@command(
    "import_gps",
    example="import_gps track.csv --map_mission=59f0 --gps_lever_arm_m=0.1,0,0.3",
    see_also=("import_trajectory", "optimize_visual_inertial"),
    reads=("gps_file",),
)
def import_gps(
    context: CommandContext,
    gps_file: Path,
    *,
    map_mission: str = "",
    options: poses.GpsOptions = _GPS,
) -> poses.GpsImport:
    """Attach positions of a satellite receiver to the vertices of a mission.

    Positions become east, north and up of an origin, which the map keeps, and G becomes that frame: the
    mission's base frame moves by yaw and position. optvi then observes yaw and position.

    Args:
        gps_file: CSV with time, latitude, longitude [deg] and ellipsoidal altitude [m], NMEA, or a bag of
            ROS 1 or ROS 2 with sensor_msgs/NavSatFix.
    """
    from maplab_py.algorithms.external_poses.gps import attach_fixes
    from maplab_py.interop.gps import read_fixes

    mission = context.mission_row(map_mission)
    track = read_fixes(gps_file, options.date, options.topic, options.time_unit)
    result, report = attach_fixes(context.vi_map, mission, track, options)
    context.commit(result)
    return report


@command(
    "import_wheel_odometry",
    example="import_wheel_odometry wheels.csv --map_mission=59f0 --wheel_position_m=-0.2,0,-0.3",
    see_also=("import_trajectory", "optimize_visual_inertial"),
    reads=("wheel_file",),
)
def import_wheel_odometry(
    context: CommandContext,
    wheel_file: Path,
    *,
    map_mission: str = "",
    options: poses.WheelOptions = _WHEELS,
) -> poses.WheelImport:
    """Join the vertices of a mission by wheel odometry.

    The file has poses, motions or velocities, told apart by the names of its columns. optvi can estimate
    the scale of the distances, which tyres and their pressure change.

    Args:
        wheel_file: CSV with a header: time, then x, y, yaw or dx, dy, dyaw or vx, vy, wz [m, rad, s]; poses
            with qx, qy, qz, qw and velocities with wx, wy, wz are of all six directions.
    """
    from maplab_py.algorithms.external_poses.wheels import attach_wheels
    from maplab_py.interop.wheel_odometry import read_wheel_odometry

    mission = context.mission_row(map_mission)
    track = read_wheel_odometry(wheel_file, options.time_unit)
    if track.note:
        context.terminal.note(track.note)
    result, report = attach_wheels(context.vi_map, mission, track, options)
    context.commit(result)
    return report
