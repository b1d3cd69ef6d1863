"""Flights along recorded trajectories: their common frame, and the IMU samples recorded with them."""

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import UserError
from maplab_py.geometry import se3, so3
from maplab_py.interop import imu_csv, trajectories
from maplab_py.simulation.recording import recorded_samples
from maplab_py.simulation.scenario import SessionOptions, WorldOptions
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import SimulatedData, simulate
from maplab_py.simulation.trajectory_motion import trajectory_spline
from tests.support.data import REPOSITORY, shared_data

EXAMPLES = REPOSITORY / "docs" / "examples" / "recorded_flights"
ROOM = WorldOptions(room_size_m=(20.0, 20.0, 8.0), landmarks_per_room=300)
BEGIN_NS = 1_500_000_000_000_000_000


def _write_circle(path: Path, *, x_m: float, seconds: float = 8.0, biases: bool = True) -> None:
    """Write a slow circle about (x, 0, 1) in the file's frame, 20 poses per second."""
    time = np.arange(int(20 * seconds) + 1) / 20.0
    angle = 0.2 * time
    p = np.stack([x_m + 2.0 * np.cos(angle), 2.0 * np.sin(angle), 1.0 + 0.0 * angle], axis=1)
    q = so3.exp(np.stack([0.0 * angle, 0.0 * angle, angle], axis=1))
    state = {}
    if biases:
        bias = np.stack([0.01 * time, 0.0 * time, 0.0 * time], axis=1)
        state = {"v_R": 0.0 * bias, "gyro_bias": bias, "accel_bias": 2.0 * bias}
    times = BEGIN_NS + np.round(time * 1e9).astype(np.int64)
    trajectories.write_euroc(trajectories.Trajectory(times, se3.make(q, p), **state), path)


def _write_imu(path: Path, *, begin_s: float = -1.0, seconds: float = 12.0) -> imu_csv.ImuRecording:
    time = begin_s + np.arange(int(200 * seconds)) / 200.0
    times = BEGIN_NS + np.round(time * 1e9).astype(np.int64)
    samples = np.random.default_rng(0).normal(size=(len(time), 6))
    imu_csv.write_imu_csv(imu_csv.ImuRecording(times, samples), path)
    return imu_csv.ImuRecording(times, samples)


def _session(folder: Path, name: str = "a.csv", **options: object) -> SessionOptions:
    given = {"trajectory": str(folder / name), "duration_s": 5.0, **options}
    return SessionOptions(**given)  # type: ignore[arg-type]


# -- placing --------------------------------------------------------------------------------------


def test_trajectories_keep_their_common_frame(tmp_path: Path) -> None:
    _write_circle(tmp_path / "a.csv", x_m=0.0)
    _write_circle(tmp_path / "b.csv", x_m=1.5)
    sessions = tuple(
        _session(tmp_path, name, keep_frame=True, height_m=2.0) for name in ("a.csv", "b.csv")
    )
    starts = [
        trajectory_spline(session, ROOM, sessions).evaluate([0.0]).T_G_I[0] for session in sessions
    ]
    np.testing.assert_allclose(starts[1][4:] - starts[0][4:], [1.5, 0.0, 0.0], atol=1e-9)
    assert starts[0][6] == pytest.approx(2.0)


def test_trajectories_are_placed_by_themselves_without_it(tmp_path: Path) -> None:
    _write_circle(tmp_path / "a.csv", x_m=0.0)
    _write_circle(tmp_path / "b.csv", x_m=1.5)
    starts = [
        trajectory_spline(_session(tmp_path, name), ROOM).evaluate([0.0]).T_G_I[0]
        for name in ("a.csv", "b.csv")
    ]
    np.testing.assert_allclose(starts[1], starts[0], atol=1e-9)


def test_a_part_in_the_middle_of_a_trajectory(tmp_path: Path) -> None:
    _write_circle(tmp_path / "a.csv", x_m=0.0)
    whole = trajectory_spline(_session(tmp_path, duration_s=7.5), ROOM).evaluate([2.5, 3.5]).T_G_I
    part = trajectory_spline(_session(tmp_path, trajectory_start_s=2.5), ROOM)
    moved = part.evaluate([0.0, 1.0]).T_G_I
    np.testing.assert_allclose(
        se3.relative(moved[0], moved[1]), se3.relative(whole[0], whole[1]), atol=1e-5
    )
    with pytest.raises(UserError, match=r"lasts 2\.0 s after 6 s, less than 5 s"):
        trajectory_spline(_session(tmp_path, trajectory_start_s=6.0), ROOM)


# -- recorded IMU samples -------------------------------------------------------------------------


def _simulated(folder: Path, text: str = "") -> SimulatedData:
    (folder / "mine.yaml").write_text(
        "world: {landmarks_per_room: 300}\nmeasurement: {frame_rate_hz: 20}\n" + text + "sessions: "
        "[{trajectory: a.csv, recorded_imu: imu.csv, duration_s: 5, trajectory_start_s: 1}]\n"
    )
    return simulate(load_scenario(folder / "mine.yaml"))


def test_recorded_samples_are_those_of_the_file(tmp_path: Path) -> None:
    _write_circle(tmp_path / "a.csv", x_m=0.0)
    imu = _write_imu(tmp_path / "imu.csv")
    recording = _simulated(tmp_path).recordings[0].recording
    first = int(np.searchsorted(imu.times_ns, BEGIN_NS + 1_000_000_000))
    np.testing.assert_array_equal(recording.imu.accel_gyro, imu.accel_gyro[first : first + 1001])
    np.testing.assert_array_equal(np.diff(recording.imu_time_ns), 5_000_000)
    np.testing.assert_array_equal(np.diff(recording.time_ns), 50_000_000)
    assert len(recording.time_ns) == 101
    # biases of the file, from the part that is used
    np.testing.assert_allclose(recording.imu.gyro_bias[[0, 1000], 0], [0.01, 0.06], atol=1e-9)
    np.testing.assert_allclose(recording.imu.accel_bias[[0, 1000], 0], [0.02, 0.12], atol=1e-9)


def test_images_are_taken_where_the_file_says(tmp_path: Path) -> None:
    _write_circle(tmp_path / "a.csv", x_m=0.0)
    _write_imu(tmp_path / "imu.csv")
    recording = _simulated(tmp_path).recordings[0].recording
    poses = trajectories.read_trajectory(tmp_path / "a.csv").T_R_B[20:121]
    np.testing.assert_allclose(
        se3.relative(recording.motion.T_G_I[:1], recording.motion.T_G_I),
        se3.relative(poses[:1], poses),
        atol=1e-8,
    )


def test_a_rolling_shutter_leaves_time_at_both_ends(tmp_path: Path) -> None:
    _write_circle(tmp_path / "a.csv", x_m=0.0)
    _write_imu(tmp_path / "imu.csv")
    recording = _simulated(tmp_path, "cameras: [{line_delay_s: 2.0e-5}]\n").recordings[0].recording
    assert recording.frame_s[0] == pytest.approx(0.01)
    assert recording.frame_s[-1] <= 5.0 - 480 * 2e-5


@pytest.mark.parametrize(
    ("begin_s", "biases", "message"),
    [
        (-1.0, False, r"recorded_imu: .*a\.csv has no biases"),
        (20.0, True, r"recorded_imu: .*imu\.csv has no samples within the 5 s"),
    ],
)
def test_files_that_do_not_belong_together(
    tmp_path: Path, begin_s: float, biases: bool, message: str
) -> None:
    _write_circle(tmp_path / "a.csv", x_m=0.0, biases=biases)
    _write_imu(tmp_path / "imu.csv", begin_s=begin_s)
    options = _session(tmp_path, recorded_imu=str(tmp_path / "imu.csv"))
    with pytest.raises(UserError, match=message) as caught:
        recorded_samples(options)
    assert "\n" not in str(caught.value)
    with pytest.raises(UserError, match=r"sessions\.recorded_imu: "):
        recorded_samples(dataclasses.replace(options, recorded_imu="absent.csv"))


# -- the flights of EuRoC -------------------------------------------------------------------------


def _example(folder: Path, name: str, *files: str, **changes: str) -> SimulatedData:
    """Simulate the first seconds of an example beside the files that it names."""
    for file in files:
        shutil.copy(shared_data(f"euroc_imu/{file}"), folder / file)
    text = (EXAMPLES / name).read_text()
    for old, new in changes.items():
        text = text.replace(old, new)
    (folder / name).write_text(text)
    scenario = load_scenario(folder / name)
    short = tuple(dataclasses.replace(s, duration_s=12.0) for s in scenario.sessions)
    return simulate(dataclasses.replace(scenario, sessions=short))


def test_the_flights_through_the_vicon_room_share_its_frame(tmp_path: Path) -> None:
    files = "V101.gt.csv", "V102.gt.csv"
    data = _example(tmp_path, "vicon_room.yaml", *files)
    starts = [session.recording.imu_motion.T_G_I[0] for session in data.recordings]
    expected = [trajectories.read_trajectory(tmp_path / file).T_R_B[0] for file in files]
    np.testing.assert_allclose(
        starts[1][4:] - starts[0][4:], expected[1][4:] - expected[0][4:], atol=1e-6
    )
    # the cameras look at the walls, as in the recording, not at the ceiling
    T_I_C = data.recordings[0].device.rig.T_B_C[0]
    ahead = so3.rotate(se3.compose(data.truth.T_G_I[:1], T_I_C)[:, :4], np.array([0.0, 0.0, 1.0]))
    assert abs(ahead[0, 2]) < 0.6


def test_recorded_samples_of_a_flight_agree_with_its_motion(tmp_path: Path) -> None:
    files = "V101.gt.csv", "V102.gt.csv", "V101.imu.csv"
    data = _example(
        tmp_path, "vicon_room.yaml", *files, **{"0.95,": "0.95, recorded_imu: V101.imu.csv,"}
    )
    recording = data.recordings[0].recording
    rate = recording.imu.accel_gyro[:, 3:] - recording.imu.gyro_bias
    # turns between two images: by the gyroscope, and of the true poses
    felt = 0.5 * 0.005 * (rate[:-1] + rate[1:])[:2400].reshape(240, 10, 3).sum(axis=1)
    T_G_I = recording.motion.T_G_I
    turns = so3.log(so3.multiply(so3.inverse(T_G_I[:-1, :4]), T_G_I[1:, :4]))
    assert np.rad2deg(np.abs(turns).max()) > 1.0
    assert np.rad2deg(np.std(felt - turns[:240])) < 0.02
    expected = imu_csv.read_imu_csv(tmp_path / "V101.imu.csv").accel_gyro[: len(rate)]
    np.testing.assert_array_equal(recording.imu.accel_gyro, expected)
