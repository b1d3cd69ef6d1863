"""The odometry on topics of real nodes of ROS 2 Jazzy and Kilted, ROS 1 and Foxglove, as on the folder."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest

from tests.interop.live.robots import maplab, run_live, write_messages
from tests.support.data import shared_data

pytestmark = pytest.mark.slow

SECONDS = 5.0
RATE = "--rate 0.15"  # of real time: tests share the machine with other tests
FIRST_PART, SECOND_PART = "--limit 480 --killed", "--begin_s 2"
POSES_ONLY = "--rovioli_run_map_builder=false --export_estimated_poses_to_csv="


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the calibration, the messages to play, and the odometry on the EuRoC folder."""
    source, folder = shared_data("euroc_mh01_10s"), tmp_path_factory.mktemp("recorded")
    write_messages(source, folder, seconds=SECONDS)
    command = f"rovioli {source} --vio_rosbag_end_s={SECONDS} {POSES_ONLY}{folder / 'poses.csv'}"
    subprocess.run(maplab(command), check=True, timeout=600)
    return folder


@pytest.mark.parametrize("robot", ["jazzy", "kilted", "noetic", "foxglove"])
def test_poses_are_those_of_the_folder(recorded: Path, tmp_path: Path, robot: str) -> None:
    flags = f"--live_max_delay_s=60 {POSES_ONLY}{tmp_path / 'poses.csv'}"
    run = run_live(tmp_path, robot, recorded, flags, RATE)
    expected, poses = (
        np.loadtxt(folder / "poses.csv", delimiter=",") for folder in (recorded, tmp_path)
    )
    times, rows, live_rows = np.intersect1d(expected[:, 0], poses[:, 0], return_indices=True)
    assert len(times) >= len(expected) - 2, (
        run.printed
    )  # a reliable reader may join after the first
    error_m = np.linalg.norm(expected[rows, 1:4] - poses[live_rows, 1:4], axis=1)
    assert np.sqrt(np.mean(error_m**2)) < 1e-3, run.printed
    assert run.seen["odometry"] >= len(poses) - 2
    assert run.seen["frames"] == ["odom", "imu"]


@pytest.mark.parametrize("robot", ["jazzy", "noetic", "foxglove"])
def test_a_publisher_that_was_killed_comes_again(
    recorded: Path, tmp_path: Path, robot: str
) -> None:
    """The second is of best effort in ROS 2; its stamps go on where those of the first end."""
    flags = f"--live_max_delay_s=60 --live_silence_s=30 {POSES_ONLY}{tmp_path / 'poses.csv'}"
    first, second = f"{RATE} {FIRST_PART}", f"{RATE} {SECOND_PART} --best_effort"
    run = run_live(tmp_path, robot, recorded, flags, first, second)
    assert run.status == 0, run.printed
    assert run.seen["odometry"] > 20  # by the second player
    poses = np.loadtxt(tmp_path / "poses.csv", delimiter=",")
    assert np.all(np.diff(poses[:, 0]) > 0)


def test_a_master_that_starts_again_is_found(recorded: Path, tmp_path: Path) -> None:
    """Connections go on without a master; nodes of ROS 1 that start afterwards need it."""
    master = "timeout -s KILL 35 rosmaster --core -p 11311; sleep 3; rosmaster --core -p 11311"
    flags = f"--live_max_delay_s=60 --live_silence_s=30 {POSES_ONLY}{tmp_path / 'poses.csv'}"
    first, second = f"--rate 0.05 {FIRST_PART}", f"{RATE} {SECOND_PART}"
    run = run_live(tmp_path, "noetic", recorded, flags, first, second, master=master)
    assert run.status == 0, run.printed
    assert "does not answer" in run.printed
    assert "is there again" in run.printed
    assert run.seen["odometry"] > 20


def test_another_domain_is_answered_with_what_to_do(recorded: Path, tmp_path: Path) -> None:
    run = run_live(
        tmp_path,
        "jazzy",
        recorded,
        "--ros_domain_id=12 --live_wait_s=5",
        f"{RATE} --limit 20 --wait_s 30",
    )
    assert run.status == 2
    assert "ROS 2 domain 12: nobody publishes /imu0" in run.printed
    assert "start the publisher, or choose other topics" in run.printed


def test_a_topic_of_another_type_is_answered_with_what_to_do(
    recorded: Path, tmp_path: Path
) -> None:
    run = run_live(
        tmp_path, "jazzy", recorded, "--imu_topic=/cam0/image_raw", f"{RATE} --limit 20 --wait_s 30"
    )
    assert run.status == 2
    assert (
        "has messages of type sensor_msgs/msg/Image, needed is sensor_msgs/msg/Imu" in run.printed
    )
