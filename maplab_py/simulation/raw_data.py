"""Raw recordings as EuRoC folders, and their ground truth in separate folders.

`raw/session_1/mav0` has `imu0` and `cam0`, `cam1`, ... with `data.csv`, `sensor.yaml` and, where
the scenario renders images, `data/<time stamp>.png`, and the true states as EuRoC has them, in
`state_groundtruth_estimate0`. `truth/session_1` has the same states and depth images (millimetres
along the optical axis, 16 bit), `truth/mesh.ply` the surfaces.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from maplab_py.array_types import F64
from maplab_py.geometry import se3
from maplab_py.interop.imu_csv import ImuRecording as ImuFile
from maplab_py.interop.imu_csv import write_imu_csv
from maplab_py.interop.trajectories import Trajectory, write_euroc
from maplab_py.output_files import write_text
from maplab_py.progress import SILENT, Progress
from maplab_py.sensors import Camera, Distortion, Imu, Projection
from maplab_py.simulation.image_files import SessionFolders, write_images
from maplab_py.simulation.mesh import write_mesh
from maplab_py.simulation.ray_caster import painted_boxes
from maplab_py.simulation.scenario import Scenario
from maplab_py.simulation.scene import make_scene
from maplab_py.simulation.simulate import RecordedSession, SimulatedData
from maplab_py.simulation.wheels import wheel_velocities, write_wheel_velocities

_SCENE_STREAM, _REPAINT_STREAM, _WHEEL_STREAM = 21, 24, 25
_DISTORTION_NAMES = {
    Distortion.NONE: "none",
    Distortion.RADTAN: "radial-tangential",
    Distortion.EQUIDISTANT: "equidistant",
    Distortion.FOV: "fov",
}


def write_raw_data(
    scenario: Scenario,
    data: SimulatedData,
    folder: Path,
    *,
    overwrite: bool = False,
    progress: Progress = SILENT,
) -> list[Path]:
    """Write the sensor recordings of all sessions.

    Returns:
        The folders of the sessions.

    Raises:
        UserError: A file exists and `overwrite` is not set, or cannot be written.
        Cancelled: The user wants to stop.
    """
    scene = None
    if scenario.images.render:
        rng = np.random.default_rng([scenario.seeds.world, _SCENE_STREAM])
        scene = make_scene(data.world.bounds, data.world.boxes, scenario.images, rng)
        truth_folder = folder / "truth"
        truth_folder.mkdir(parents=True, exist_ok=True)
        write_mesh(scene.surfaces, truth_folder / "mesh.ply")
    folders = []
    for number, session in enumerate(data.recordings):
        name = f"session_{number + 1}"
        target = folder / "raw" / name
        _write_session(scenario, session, target / "mav0", overwrite=overwrite)
        if scenario.other_sensors.wheel_odometry:
            rng = np.random.default_rng([scenario.seeds.measurement, _WHEEL_STREAM, number])
            wheels = wheel_velocities(session.recording, scenario.other_sensors, rng)
            path = target / "mav0" / "wheel0" / "data.csv"
            path.parent.mkdir(parents=True, exist_ok=True)
            write_wheel_velocities(wheels, path, overwrite=overwrite)
        truth = folder / "truth" / name
        _write_trajectory(session, truth / "ground_truth.csv", overwrite=overwrite)
        states = target / "mav0" / "state_groundtruth_estimate0"
        _write_trajectory(session, states / "data.csv", overwrite=overwrite)
        _write_lines(states / "sensor.yaml", _states_yaml(), overwrite)
        if scene is not None:
            rng = np.random.default_rng([scenario.seeds.appearance, _REPAINT_STREAM, number])
            share = scenario.sessions[number].images.repainted_share
            painted = painted_boxes(scene.repainted(share, rng))
            to = SessionFolders(target / "mav0", truth)
            write_images(scenario, number, session, painted, to, progress=progress)
        folders.append(target)
    return folders


def _write_session(
    scenario: Scenario, session: RecordedSession, mav: Path, *, overwrite: bool
) -> None:
    device, recording = session.device, session.recording
    imu = device.sensor_set.imu(device.imu_id)
    (mav / "imu0").mkdir(parents=True, exist_ok=True)
    table = ImuFile(recording.imu_time_ns, recording.imu.accel_gyro)
    write_imu_csv(table, mav / "imu0" / "data.csv", overwrite=overwrite)
    _write_lines(mav / "imu0" / "sensor.yaml", _imu_yaml(imu, scenario.imu.rate_hz), overwrite)
    stamps = [f"{stamp},{stamp}.png" for stamp in recording.time_ns.tolist()]
    for row, camera in enumerate(device.rig.cameras):
        home = mav / f"cam{row}"
        home.mkdir(parents=True, exist_ok=True)
        _write_lines(home / "data.csv", ["#timestamp [ns],filename", *stamps], overwrite)
        text = _camera_yaml(camera, device.rig.T_B_C[row], scenario.measurement.frame_rate_hz)
        _write_lines(home / "sensor.yaml", text, overwrite)


def _write_trajectory(session: RecordedSession, path: Path, *, overwrite: bool) -> None:
    """Write the true states in the form of EuRoC's ground truth, G being the world."""
    recording = session.recording
    path.parent.mkdir(parents=True, exist_ok=True)
    trajectory = Trajectory(
        recording.imu_time_ns,
        recording.imu_motion.T_G_I,
        v_R=recording.imu_motion.v_G,
        gyro_bias=recording.imu.gyro_bias,
        accel_bias=recording.imu.accel_bias,
    )
    write_euroc(trajectory, path, overwrite=overwrite)


def _write_lines(path: Path, lines: list[str], overwrite: bool) -> None:
    write_text(path, (line + "\n" for line in lines), overwrite=overwrite)


def _matrix_yaml(T_B_S: F64) -> list[str]:
    rows = [", ".join(f"{value:.17g}" for value in row) for row in se3.to_matrix(T_B_S)]
    data = ",\n         ".join(rows)
    return ["T_BS:", "  cols: 4", "  rows: 4", f"  data: [{data}]"]


def _states_yaml() -> list[str]:
    return [
        "sensor_type: visual-inertial",
        "comment: true states of the simulated body",
        *_matrix_yaml(se3.identity()),
    ]


def _imu_yaml(imu: Imu, rate_hz: float) -> list[str]:
    return [
        "sensor_type: imu",
        f"comment: {imu.description}",
        *_matrix_yaml(se3.identity()),
        f"rate_hz: {rate_hz:g}",
        f"gyroscope_noise_density: {imu.gyro_noise_density:.17g}",
        f"gyroscope_random_walk: {imu.gyro_bias_random_walk_noise_density:.17g}",
        f"accelerometer_noise_density: {imu.acc_noise_density:.17g}",
        f"accelerometer_random_walk: {imu.acc_bias_random_walk_noise_density:.17g}",
    ]


def _camera_yaml(camera: Camera, T_I_C: F64, rate_hz: float) -> list[str]:
    model = "pinhole" if camera.projection is Projection.PINHOLE else "omni"
    intrinsics = ", ".join(f"{value:.17g}" for value in camera.intrinsics)
    distortion = ", ".join(f"{value:.17g}" for value in camera.distortion_parameters)
    return [
        "sensor_type: camera",
        f"comment: {camera.description}",
        *_matrix_yaml(T_I_C),
        f"rate_hz: {rate_hz:g}",
        f"resolution: [{camera.width_px}, {camera.height_px}]",
        f"camera_model: {model}",
        f"intrinsics: [{intrinsics}]",
        f"distortion_model: {_DISTORTION_NAMES[camera.distortion]}",
        f"distortion_coefficients: [{distortion}]",
    ]
