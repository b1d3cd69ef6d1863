"""The odometry on topics of real nodes of ROS 2 Jazzy and Kilted, ROS 1 and Foxglove, as on the folder."""

import dataclasses
import subprocess
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from tests.interop.live.robots import MASTER, LiveRun, maplab, run_live, write_messages
from tests.support.data import shared_data

pytestmark = pytest.mark.slow

SECONDS = 4.0
AT_ONCE = 4
"""Runs: they wait for their players most of the time."""
RATE = "--rate 0.15"  # of real time: tests share the machine with other tests
POSES = "--rovioli_run_map_builder=false --live_max_delay_s=60 --export_estimated_poses_to_csv="
FIRST, SECOND = "--limit 240 --killed", f"{RATE} --begin_s 1"
TO_THE_END = f"--live_silence_s=30 {POSES}"
OTHERS = f"{RATE} --limit 20 --wait_s 15"


@dataclasses.dataclass(frozen=True)
class Live:
    """Arguments of a run; `flags` that end with "=" get the file of poses."""

    robot: str
    flags: str
    players: tuple[str, ...]
    master: str = MASTER


RUNS = {
    "test_a_master_that_starts_again_is_found": Live(
        "noetic",
        TO_THE_END,
        (f"--rate 0.03 {FIRST}", SECOND),
        f"timeout -s KILL 30 {MASTER}; sleep 3; {MASTER}",
    ),
    **{
        f"test_a_publisher_that_was_killed_comes_again[{robot}]": Live(
            robot, TO_THE_END, (f"{RATE} {FIRST}", f"{SECOND} --best_effort")
        )
        for robot in ("jazzy", "noetic", "foxglove")
    },
    **{
        f"test_poses_are_those_of_the_folder[{robot}]": Live(robot, POSES, (RATE,))
        for robot in ("jazzy", "kilted", "noetic", "foxglove")
    },
    "test_another_domain_is_answered_with_what_to_do": Live(
        "jazzy", "--ros_domain_id=12 --live_wait_s=5", (OTHERS,)
    ),
    "test_a_topic_of_another_type_is_answered_with_what_to_do": Live(
        "jazzy", "--imu_topic=/cam0/image_raw", (OTHERS,)
    ),
}
"""By the test that looks at it, long ones first."""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the calibration, the messages to play, and the odometry on the EuRoC folder."""
    source, folder = shared_data("euroc_mh01_10s"), tmp_path_factory.mktemp("recorded")
    write_messages(source, folder, seconds=SECONDS)
    command = f"rovioli {source} --vio_rosbag_end_s={SECONDS} {POSES}{folder / 'poses.csv'}"
    subprocess.run(maplab(command), check=True, timeout=600)
    return folder


@pytest.fixture(scope="module")
def runs(
    recorded: Path, request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[dict[str, Future[LiveRun]]]:
    """Runs of the tests that were selected."""
    selected = {item.name for item in request.session.items}
    pool, runs = ThreadPoolExecutor(AT_ONCE), {}
    for number, (name, live) in enumerate(RUNS.items()):
        if name in selected:
            folder = tmp_path_factory.mktemp("live")
            flags = live.flags + (str(folder / "poses.csv") if live.flags.endswith("=") else "")
            arguments = (folder, live.robot, recorded, flags, *live.players)
            # nodes of one domain would find each other in the machine's shared memory
            runs[name] = pool.submit(run_live, *arguments, master=live.master, domain=20 + number)
    yield runs
    pool.shutdown(cancel_futures=True)


@pytest.fixture
def run(runs: dict[str, Future[LiveRun]], request: pytest.FixtureRequest) -> LiveRun:
    return runs[request.node.name].result()


@pytest.mark.parametrize("robot", ["jazzy", "kilted", "noetic", "foxglove"])
def test_poses_are_those_of_the_folder(recorded: Path, run: LiveRun, robot: str) -> None:
    expected, poses = (
        np.loadtxt(folder / "poses.csv", delimiter=",") for folder in (recorded, run.folder)
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
def test_a_publisher_that_was_killed_comes_again(run: LiveRun, robot: str) -> None:
    """The second is of best effort in ROS 2; its stamps go on where those of the first end."""
    assert run.status == 0, run.printed
    assert run.seen["odometry"] > 20  # by the second player
    poses = np.loadtxt(run.folder / "poses.csv", delimiter=",")
    assert np.all(np.diff(poses[:, 0]) > 0)


def test_a_master_that_starts_again_is_found(run: LiveRun) -> None:
    """Connections go on without a master; nodes of ROS 1 that start afterwards need it."""
    assert run.status == 0, run.printed
    assert "does not answer" in run.printed
    assert "is there again" in run.printed
    assert run.seen["odometry"] > 20


def test_another_domain_is_answered_with_what_to_do(run: LiveRun) -> None:
    assert run.status == 2
    assert "ROS 2 domain 12: nobody publishes /imu0" in run.printed
    assert "start the publisher, or choose other topics" in run.printed


def test_a_topic_of_another_type_is_answered_with_what_to_do(run: LiveRun) -> None:
    assert run.status == 2
    said = "has messages of type sensor_msgs/msg/Image, needed is sensor_msgs/msg/Imu"
    assert said in run.printed
