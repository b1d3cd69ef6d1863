"""Raw recordings as EuRoC folders, and their ground truth in separate folders.

`raw/session_1/mav0` has `imu0` and `cam0`, `cam1`, ... with `data.csv`, `sensor.yaml` and, where
the scenario renders images, `data/<time stamp>.png`, and the true states as EuRoC has them, in
`state_groundtruth_estimate0`. `truth/session_1` has the same states and depth images (millimetres
along the optical axis, 16 bit), `truth/mesh.ply` the surfaces.
"""

import dataclasses
import os
from contextlib import closing, nullcontext
from functools import partial
from pathlib import Path

import numpy as np

from maplab_py.array_types import F64, NDArray
from maplab_py.atomic import replaced_folder, write_file
from maplab_py.cancellation import lasting_effect
from maplab_py.child_processes import in_order
from maplab_py.errors import UserError
from maplab_py.geometry import se3
from maplab_py.interop import imu_csv, trajectories
from maplab_py.interop.ply import PlyCloud, encode_ply
from maplab_py.output_files import write_text
from maplab_py.progress import SILENT, Progress
from maplab_py.sensors import Camera, Distortion, Imu, Projection
from maplab_py.simulation import imaging, ray_caster, reports, shading_kernels
from maplab_py.simulation.scenario import Scenario
from maplab_py.simulation.scene import Scene, make_scene
from maplab_py.simulation.session import wheel_velocities, write_wheel_velocities
from maplab_py.simulation.simulate import RecordedSession, SimulatedData, simulate
from maplab_py.simulation.surfaces import Surfaces
from maplab_py.simulation.walkers import Walkers
from maplab_py.simulation.world import World
from maplab_py.storage.native import save_map

_SCENE_STREAM, _REPAINT_STREAM, _WHEEL_STREAM, _WALKER_STREAM = 21, 24, 25, 26
_PROJECTION_NAMES = {
    Projection.PINHOLE: "pinhole",
    Projection.UNIFIED: "omni",
    Projection.DOUBLE_SPHERE: "ds",
    Projection.EXTENDED_UNIFIED: "eucm",
}
_DISTORTION_NAMES = {
    Distortion.NONE: "none",
    Distortion.RADTAN: "radial-tangential",
    Distortion.RADTAN5: "radial-tangential",
    Distortion.RATIONAL: "radial-tangential",
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
        scene = _scene(scenario, data.world, np.zeros((0, 2, 3)))
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
            walkers = _walkers(scenario, number, session, float(data.world.bounds[0, 2]))
            crowded = scene if walkers is None else _scene(scenario, data.world, walkers.boxes)
            painted = ray_caster.painted_boxes(crowded.repainted(share, rng))
            to = SessionFolders(target / "mav0", truth)
            write_images(scenario, number, session, painted, to, walkers, progress=progress)
        folders.append(target)
    return folders


def _scene(scenario: Scenario, world: World, walkers: F64) -> Scene:
    """Paint a world; boxes (W, 2, 3) beside it do not change how the others look."""
    rng = np.random.default_rng([scenario.seeds.world, _SCENE_STREAM])
    return make_scene(world.bounds, np.concatenate([world.boxes, walkers]), scenario.images, rng)


def _walkers(
    scenario: Scenario, number: int, session: RecordedSession, floor_m: float
) -> Walkers | None:
    images = scenario.sessions[number].images
    if not images.walkers:
        return None
    rng = np.random.default_rng([scenario.seeds.motion, _WALKER_STREAM, number])
    return Walkers.of(images, session.recording.spline, floor_m, rng)


def _write_session(
    scenario: Scenario, session: RecordedSession, mav: Path, *, overwrite: bool
) -> None:
    device, recording = session.device, session.recording
    imu = device.sensor_set.imu(device.imu_id)
    (mav / "imu0").mkdir(parents=True, exist_ok=True)
    table = imu_csv.ImuRecording(recording.imu_time_ns, recording.imu.accel_gyro)
    imu_csv.write_imu_csv(table, mav / "imu0" / "data.csv", overwrite=overwrite)
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
    trajectory = trajectories.Trajectory(
        recording.imu_time_ns,
        recording.imu_motion.T_G_I,
        v_R=recording.imu_motion.v_G,
        gyro_bias=recording.imu.gyro_bias,
        accel_bias=recording.imu.accel_bias,
    )
    trajectories.write_euroc(trajectory, path, overwrite=overwrite)


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
    intrinsics = ", ".join(f"{value:.17g}" for value in camera.intrinsics)
    distortion = ", ".join(f"{value:.17g}" for value in camera.distortion_parameters)
    return [
        "sensor_type: camera",
        f"comment: {camera.description}",
        *_matrix_yaml(T_I_C),
        f"rate_hz: {rate_hz:g}",
        f"resolution: [{camera.width_px}, {camera.height_px}]",
        f"camera_model: {_PROJECTION_NAMES[camera.projection]}",
        f"intrinsics: [{intrinsics}]",
        f"distortion_model: {_DISTORTION_NAMES[camera.distortion]}",
        f"distortion_coefficients: [{distortion}]",
    ]


_NOISE_STREAM, _GAIN_STREAM = 22, 23
_PNG_LEVEL, _HUFFMAN_ONLY = 1, 2
"""Without a search for repetitions, which noise does not have, files are smaller and sooner written."""


@dataclasses.dataclass(frozen=True, eq=False)
class SessionFolders:
    """Destination of the images of a session."""

    images: Path  # has cam0, cam1, ...
    depths: Path  # gets depth0, depth1, ...


def write_images(
    scenario: Scenario,
    number: int,
    session: RecordedSession,
    painted: shading_kernels.PaintedBoxes,
    folders: SessionFolders,
    walkers: Walkers | None = None,
    *,
    threads: int | None = None,
    progress: Progress = SILENT,
) -> None:
    """Render and write all images of a session; the bytes do not depend on the number of threads.

    Args:
        number: Which of its sessions.
        session: What was recorded, with the true motion and cameras.
        painted: The scene as this session sees it.
        folders: Where the images go.
        walkers: The last boxes of the scene; None = none of them moves.
        threads: How many images are rendered at a time; None = as many as there are processors.

    Raises:
        UserError: A file cannot be written.
        Cancelled: The user wants to stop.
    """
    count = len(session.recording.time_ns)
    seed = [scenario.seeds.measurement, _GAIN_STREAM, number]
    brightness = imaging.make_brightness(
        scenario.sessions[number].images,
        scenario.images.gain_swing,
        session.recording.spline.duration_s,
        np.random.default_rng(seed),
    )
    for row, camera in enumerate(session.device.true_rig.cameras):
        T_I_C, delay = session.device.true_rig.T_B_C[row], scenario.cameras[row].line_delay_s
        at_time = partial(session.recording.spline.poses_of, T_I_S=T_I_C)
        imager = imaging.Imager.of(
            painted, camera, scenario.images, delay, at_time, brightness, walkers
        )
        targets = folders.images / f"cam{row}" / "data", folders.depths / f"depth{row}"
        for target in targets[: 1 + scenario.images.depth]:
            target.mkdir(exist_ok=True)

        def rendered(frame: int, row: int = row, imager: imaging.Imager = imager) -> list[bytes]:
            random = [scenario.seeds.measurement, _NOISE_STREAM, number, row, frame]
            time_s = float(session.recording.frame_s[frame])
            image, depth = imager.image(time_s, np.random.default_rng(random))
            if not scenario.images.depth:
                return [_png(image)]
            millimetres = np.clip(np.round(1000.0 * depth), 0, 65535).astype(np.uint16)
            return [_png(image), _png(millimetres)]

        with closing(in_order(rendered, range(count), threads or os.cpu_count() or 1)) as files:
            for frame, contents in enumerate(files):
                progress.step(frame, count, f"images of session {number + 1}, camera {row}")
                name = f"{session.recording.time_ns[frame]}.png"
                for target, content in zip(targets, contents, strict=False):
                    with lasting_effect():
                        write_file(target / name, [content], durable=False)


def _png(image: NDArray[np.generic]) -> bytes:
    import cv2

    settings = [cv2.IMWRITE_PNG_COMPRESSION, _PNG_LEVEL, cv2.IMWRITE_PNG_STRATEGY, _HUFFMAN_ONLY]
    # one filter for all rows instead of the best of five for each: with noise there is nothing to choose
    # (1 % larger, encoded in half the time). Versions of OpenCV that have no such choice do so by themselves.
    if hasattr(cv2, "IMWRITE_PNG_FILTER"):
        settings += [cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_AVG]
    done, data = cv2.imencode(".png", image, settings)
    if not done:
        raise UserError(f"an image of {image.shape[1]} x {image.shape[0]} pixels cannot be encoded")
    return bytes(data)


def write_mesh(surfaces: Surfaces, path: Path) -> None:
    """Write surfaces as a binary PLY file: two triangles each, normals into the free space."""
    c, u, v = surfaces.corner, surfaces.side_u, surfaces.side_v
    corners = np.stack([c, c + u, c + u + v, c + v], axis=1)
    # the corners run anticlockwise about u x v; turn those whose normal is the other one
    flipped = np.einsum("fi,fi->f", np.cross(u, v), surfaces.normal) < 0.0
    corners[flipped] = corners[flipped, ::-1]
    first = 4 * np.arange(len(c))[:, None]
    triangles = np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])])
    write_file(path, encode_ply(PlyCloud(corners.reshape(-1, 3), faces=triangles)))


TRUTH_FILE = "truth.npz"


def write_maps(
    scenario: Scenario,
    map_folder: Path,
    *,
    raw_data: bool = False,
    overwrite: bool = False,
    progress: Progress = SILENT,
) -> reports.SimulatedMaps:
    """Simulate a scenario; write one map per session, the truth, and on request raw recordings.

    A new folder appears as a whole; in a folder with other files, each map is replaced by itself.

    Raises:
        UserError: The scenario cannot be simulated, or a file cannot be written.
        Cancelled: The user wants to stop.
    """
    data = simulate(scenario, progress=progress)
    is_new = not map_folder.is_dir() or not any(map_folder.iterdir())
    with replaced_folder(map_folder) if is_new else nullcontext(map_folder) as target:
        maps = []
        for folder, vi_map in zip(session_folders(target, len(data.maps)), data.maps, strict=True):
            progress.check()
            save_map(vi_map, folder, overwrite=overwrite)
            counts = len(vi_map.vertices), len(vi_map.keypoints), len(vi_map.landmarks)
            maps.append(reports.SimulatedMap(map_folder / folder.relative_to(target), *counts))
        data.truth.save(target / TRUTH_FILE)
        folders: list[Path] = []
        if raw_data:
            folders = write_raw_data(scenario, data, target, overwrite=overwrite, progress=progress)
        written = tuple(map_folder / folder.relative_to(target) for folder in folders)
    return reports.SimulatedMaps(tuple(maps), map_folder / TRUTH_FILE, written)


def session_folders(folder: Path, count: int) -> list[Path]:
    """Return the folders of so many sessions."""
    return [folder / f"session_{number + 1}" for number in range(count)]


def refuse_used_folder(folder: Path, *, overwrite: bool) -> None:
    """Refuse a folder that is not empty, before any work is done; raises UserError."""
    if folder.exists() and not folder.is_dir():
        raise UserError(f"--map_folder={folder} is a file")
    if not overwrite and folder.is_dir() and any(folder.iterdir()):
        raise UserError(f"--map_folder={folder} is not empty; give another one or --overwrite")
