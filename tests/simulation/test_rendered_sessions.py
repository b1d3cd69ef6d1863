"""Rendered sessions: brightness, repainted and bare surfaces, files, and recordings to read again."""

import dataclasses
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from maplab_py.errors import UserError
from maplab_py.geometry import se3
from maplab_py.interop.recordings import protocol, reader_choice, stream
from maplab_py.interop.trajectories import read_trajectory
from maplab_py.simulation import imaging, raw_data, ray_caster, scenario_file
from maplab_py.simulation import scenario as sim
from maplab_py.simulation.scene import Scene, make_scene
from maplab_py.simulation.simulate import SimulatedData, simulate
from maplab_py.simulation.walkers import Walkers

CAMERA = sim.CameraOptions(
    intrinsics=(95.0, 95.0, 94.0, 60.0), width_px=188, height_px=120, position_m=(0.05, 0.06, 0.0)
)
FLIGHT = sim.Scenario(
    world=sim.WorldOptions(landmarks_per_room=600),
    cameras=(CAMERA, dataclasses.replace(CAMERA, position_m=(0.05, -0.06, 0.0))),
    measurement=sim.MeasurementOptions(frame_rate_hz=5.0),
    images=sim.ImageOptions(
        render=True, texel_m=0.02, gain_swing=0.0, vignette=0.0, noise_sigma=0.0
    ),
    sessions=(sim.SessionOptions(kind="loop", duration_s=1.0, turns=0.03),),
)
ROOM = np.array([[-4.0, -3.0, 0.0], [4.0, 3.0, 3.0]])


@cache
def data() -> SimulatedData:
    return simulate(FLIGHT)


def _scene(**options: float) -> Scene:
    boxes = np.array([[[1.0, 1.0, 0.0], [2.0, 2.0, 2.0]]])
    image_options = sim.ImageOptions(texel_m=0.02, **options)  # type: ignore[arg-type]
    return make_scene(ROOM, boxes, image_options, np.random.default_rng(1))


def _first_images(folder: Path, **images: float) -> list[np.ndarray]:
    """Render a session with its own light or paint; return the images of the left camera."""
    session = dataclasses.replace(
        FLIGHT.sessions[0],
        images=sim.SessionImages(**images),  # type: ignore[arg-type]
    )
    scenario = dataclasses.replace(FLIGHT, sessions=(session,))
    raw_data.write_raw_data(scenario, data(), folder)
    files = sorted((folder / "raw" / "session_1" / "mav0" / "cam0" / "data").iterdir())
    return [cv2.imread(str(file), cv2.IMREAD_UNCHANGED).astype(float) for file in files]


# -- brightness -----------------------------------------------------------------------------------


def test_light_multiplies_grey_values(tmp_path: Path) -> None:
    plain = _first_images(tmp_path / "plain")
    dark = _first_images(tmp_path / "dark", light=0.25)
    for image, darker in zip(plain, dark, strict=True):
        np.testing.assert_allclose(darker, 0.25 * image, atol=0.63)


def test_the_gain_jumps_at_random_times_and_stays_in_between() -> None:
    options = sim.SessionImages(gain_jump=0.4, gain_jump_every_s=2.0)
    brightness = imaging.make_brightness(options, 0.0, 400.0, np.random.default_rng(3))
    assert 150 < len(brightness.jump_s) < 250
    times = np.linspace(0.0, 400.0, 20_001)
    gain = np.array([brightness.at(time) for time in times])
    assert np.count_nonzero(np.diff(gain)) == pytest.approx(len(brightness.jump_s), abs=3)
    assert gain[0] == 1.0
    assert 0.6 <= gain.min() < 0.65
    assert 1.35 < gain.max() <= 1.4


def test_both_cameras_have_the_same_gain_at_a_time() -> None:
    brightness = imaging.Brightness(0.5, 0.1, np.array([1.0]), np.array([1.0, 1.2]))
    assert brightness.at(0.5) == pytest.approx(0.5 * (1.0 + 0.1 * np.sin(np.pi / 7.0)))
    assert brightness.at(7.0) == pytest.approx(0.6)


# -- walkers --------------------------------------------------------------------------------------


def test_walkers_cross_the_view_while_they_are_wanted(tmp_path: Path) -> None:
    greys: list[list[np.ndarray]] = []
    depths: list[list[np.ndarray]] = []
    times_s = np.zeros(0)
    for walkers in (0, 3):
        images = sim.SessionImages(
            walkers=walkers, walkers_from_s=0.5, walkers_until_s=3.0, repainted_share=0.1
        )
        session = dataclasses.replace(FLIGHT.sessions[0], duration_s=4.0, images=images)
        scenario = dataclasses.replace(FLIGHT, sessions=(session,))
        simulated = simulate(scenario)
        raw_data.write_raw_data(scenario, simulated, tmp_path / str(walkers))
        times_s = simulated.recordings[0].recording.frame_s
        folder = tmp_path / str(walkers) / "truth" / "session_1" / "depth0"
        depths.append([cv2.imread(str(file), -1) for file in sorted(folder.iterdir())])
        files = sorted((tmp_path / str(walkers) / "raw/session_1/mav0/cam0/data").iterdir())
        greys.append([cv2.imread(str(file), -1) for file in files])
    for row, time_s in enumerate(times_s):
        is_walker = depths[0][row] != depths[1][row]
        assert (depths[1][row][is_walker] < depths[0][row][is_walker]).all()
        far = cv2.dilate(is_walker.astype(np.uint8), np.ones((9, 9))) == 0
        assert np.abs(greys[0][row].astype(int) - greys[1][row])[far].max(initial=0) <= 1
        if time_s < 0.5 or time_s >= 3.0:
            assert not is_walker.any()
    covered = [(a != b).mean() for a, b in zip(*depths, strict=True)]
    during = [share for share, time_s in zip(covered, times_s, strict=True) if 1.5 < time_s < 3.0]
    assert 0.1 < np.mean(during) < 0.6
    assert np.ptp(during) > 0.02


def test_a_walker_has_constant_velocity_on_each_crossing() -> None:
    spline = data().recordings[0].recording.spline
    options = sim.SessionImages(walkers=1, walkers_until_s=5.0)
    walkers = Walkers.of(options, spline, 0.0, np.random.default_rng(1))
    places = np.array([walkers.offset(time_s)[0] for time_s in np.arange(0.1, 2.4, 0.2)])
    steps = np.diff(places, axis=0)
    np.testing.assert_allclose(steps, np.tile(steps[0], (len(steps), 1)), atol=1e-12)
    assert 0.3 <= np.linalg.norm(steps[0]) / 0.2 <= 1.0
    assert (places[:, 2] == 0.0).all()
    assert np.linalg.norm(walkers.offset(2.6)[0] - places[-1]) > 0.5
    assert walkers.offset(5.1)[0, 2] < -100.0


# -- surfaces -------------------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.1, 0.5])
def test_the_wanted_share_of_the_surfaces_is_repainted(share: float) -> None:
    scene = _scene()
    other = scene.repainted(share, np.random.default_rng(7))
    texture, changed = scene.textures, other.textures
    finest = np.concatenate(
        [
            texture.offset[row, 0] + np.arange(texture.width[row, 0] * texture.height[row, 0])
            for row in range(len(texture.offset))
        ]
    )
    # a repainted patch has its former grey value here and there
    is_new = texture.pixels[finest] != changed.pixels[finest]
    assert is_new.mean() == pytest.approx(share, rel=0.15)
    np.testing.assert_array_equal(texture.offset, changed.offset)


def test_a_session_that_repaints_nothing_has_the_scene_itself() -> None:
    scene = _scene()
    assert scene.repainted(0.0, np.random.default_rng(0)) is scene


def test_sessions_see_differently_repainted_rooms(tmp_path: Path) -> None:
    plain = _first_images(tmp_path / "plain")
    other = _first_images(tmp_path / "other", repainted_share=0.2)
    changed = np.mean([np.abs(a - b) > 3.0 for a, b in zip(plain, other, strict=True)])
    assert 0.05 < changed < 0.4


def test_bare_surfaces_have_hardly_any_corners() -> None:
    painted, bare = _scene(), _scene(bare_share=1.0)
    assert bare.textures.is_bare.all()
    assert not painted.textures.is_bare.any()
    corners = []
    for scene in (painted, bare):
        texture = scene.textures
        size = texture.height[0, 0], texture.width[0, 0]
        begin = texture.offset[0, 0]
        wall = texture.pixels[begin : begin + size[0] * size[1]].reshape(size)
        found = cv2.goodFeaturesToTrack(wall, 5000, 1e-3, 3)
        corners.append(0 if found is None else len(found))
    assert corners[1] < 0.1 * corners[0]


def test_a_share_of_the_surfaces_is_bare() -> None:
    boxes = np.tile(np.array([[[1.0, 1.0, 0.0], [1.2, 1.2, 0.2]]]), (60, 1, 1))
    options = sim.ImageOptions(texel_m=0.1, bare_share=0.3)
    scene = make_scene(ROOM, boxes, options, np.random.default_rng(0))
    assert scene.textures.is_bare.mean() == pytest.approx(0.3, abs=0.07)


# -- files ----------------------------------------------------------------------------------------


def test_the_number_of_threads_does_not_change_a_byte(tmp_path: Path) -> None:
    scenario = dataclasses.replace(
        FLIGHT, images=dataclasses.replace(FLIGHT.images, noise_sigma=2.0)
    )
    painted = ray_caster.painted_boxes(
        make_scene(
            data().world.bounds, data().world.boxes, scenario.images, np.random.default_rng(0)
        )
    )
    contents = []
    for threads in (1, 2, 5):
        folder = tmp_path / str(threads)
        for row in (0, 1):
            (folder / f"cam{row}").mkdir(parents=True)
        folders = raw_data.SessionFolders(folder, folder)
        raw_data.write_images(scenario, 0, data().recordings[0], painted, folders, threads=threads)
        files = sorted(path for path in folder.rglob("*.png"))
        contents.append({file.relative_to(folder): file.read_bytes() for file in files})
    assert len(contents[0]) == 24
    assert contents[0] == contents[1] == contents[2]


def test_a_written_folder_is_a_recording(tmp_path: Path) -> None:
    raw_data.write_raw_data(FLIGHT, data(), tmp_path)
    folder = tmp_path / "raw" / "session_1"
    recording = reader_choice.open_recording(folder)
    session = data().recordings[0]
    events = list(stream.EventStream(recording))
    frames = [event for event in events if isinstance(event, protocol.FrameSet)]
    imu = [event for event in events if isinstance(event, protocol.ImuBatch)]
    np.testing.assert_array_equal([frame.time_ns for frame in frames], session.recording.time_ns)
    np.testing.assert_array_equal(
        np.concatenate([batch.accel_gyro for batch in imu]), session.recording.imu.accel_gyro
    )
    np.testing.assert_allclose(recording.device.T_I_C, session.device.rig.T_B_C, atol=1e-12)
    for camera, stored in zip(recording.device.cameras, session.device.rig.cameras, strict=True):
        np.testing.assert_array_equal(camera.intrinsics, stored.intrinsics)
        np.testing.assert_array_equal(camera.distortion_parameters, stored.distortion_parameters)
    assert all(image.grey().shape == (120, 188) for frame in frames for image in frame.images)
    states = read_trajectory(folder / "mav0" / "state_groundtruth_estimate0" / "data.csv")
    np.testing.assert_allclose(states.T_R_B, session.recording.imu_motion.T_G_I)
    np.testing.assert_allclose(states.v_R, session.recording.imu_motion.v_G)
    np.testing.assert_allclose(states.gyro_bias, session.recording.imu.gyro_bias)
    np.testing.assert_allclose(states.accel_bias, session.recording.imu.accel_bias)


# -- scenarios ------------------------------------------------------------------------------------


def _motion(name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return positions, speeds [m/s] and rates [rad/s] of a scenario at 200 Hz."""
    scenario = scenario_file.load_scenario(name)
    few = dataclasses.replace(
        scenario,
        world=dataclasses.replace(scenario.world, landmarks_per_room=100),
        measurement=dataclasses.replace(scenario.measurement, frame_rate_hz=1.0),
    )
    motion = simulate(few).recordings[0].recording.imu_motion
    speed, rate = (np.linalg.norm(column, axis=1) for column in (motion.v_G, motion.w_I))
    return motion.T_G_I[:, 4:], speed, rate


def test_flights_do_what_their_names_say() -> None:
    _, easy, easy_rate = _motion("flight_easy")
    assert easy.max() < 1.2
    assert easy_rate.max() < 1.2
    _, fast, fast_rate = _motion("flight_fast")
    assert fast.mean() > 1.2
    assert fast_rate.max() > 2.0
    _, speed, rate = _motion("flight_stop_and_go")
    at_rest = (speed < 1e-3) & (rate < 1e-3)
    assert at_rest.sum() / 200.0 >= 60.0
    assert np.count_nonzero(np.diff(at_rest.astype(int)) == -1) == 4
    position, speed, rate = _motion("turn_on_the_spot")
    turning = slice(17 * 200, 35 * 200)
    assert np.ptp(position[turning], axis=0).max() < 1e-6
    assert rate[turning].mean() > 0.4


@pytest.mark.parametrize(
    ("session", "message"),
    [
        ("images: {light: 0}", r"sessions\[0\].images.light: must be above 0"),
        ("images: {repainted_share: 2}", "repainted_share: must be at least 0 and at most 1"),
        ("images: {gain_jump: 1}", "gain_jump: must be at least 0 and below 1"),
        ("images: {gain_jump_every_s: -1}", "gain_jump_every_s: must be at least 0"),
        ("images: {dark: 1}", "images.dark: unknown key"),
        ("recorded_imu: imu.csv", "recorded_imu: is of a trajectory"),
        ("keep_frame: true", "keep_frame: is of a trajectory"),
        ("trajectory_start_s: -1", "trajectory_start_s: must be at least 0"),
    ],
)
def test_mistakes_in_sessions_are_named(session: str, message: str) -> None:
    with pytest.raises(UserError, match=message) as caught:
        scenario_file.parse_scenario(f"sessions: [{{{session}}}]", "mine.yaml")
    assert "\n" not in str(caught.value)


def test_poses_of_the_states_are_those_of_the_images() -> None:
    session = data().recordings[0]
    at_images = session.recording.spline.evaluate(session.recording.frame_s).T_G_I
    rows = session.recording.imu_row
    np.testing.assert_allclose(
        se3.local(session.recording.imu_motion.T_G_I[rows], at_images), 0.0, atol=1e-9
    )
