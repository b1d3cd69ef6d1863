"""The odometry on topics of real nodes of ROS 2 Jazzy and Kilted, ROS 1 and Foxglove, as on the folder."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maplab_py.interop.recordings.opening import open_recording
from maplab_py.interop.recordings.protocol import CameraImage, ImuBatch
from tests.interop.live.environments import in_network_namespace, python_of
from tests.interop.recordings.written import write_calibration
from tests.support.data import shared_data

pytestmark = pytest.mark.slow

NODES = Path(__file__).parent / "nodes"
SECONDS = 5.0
RATE = 0.15  # of real time: tests share the machine with other tests
LONGEST_S = 240.0
TOPICS = "--camera_topics=/cam0/image_raw,/cam1/image_raw --imu_topic=/imu0"
PLAYERS = {
    "jazzy": "ros2_player.py",
    "kilted": "ros2_player.py",
    "noetic": "ros1_player.py",
    "foxglove": "foxglove_player.py",
}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the calibration, the messages to play, and the odometry on the EuRoC folder."""
    source, folder = shared_data("euroc_mh01_10s"), tmp_path_factory.mktemp("recorded")
    recording = open_recording(source)
    write_calibration(recording.device, folder / "sensors.yaml")
    end_ns = recording.start_ns + round(SECONDS * 1e9)
    times, samples, stamps, pixels = [], [], ([], []), ([], [])  # type: ignore[var-annotated]
    for item in recording.items(None, end_ns):
        if isinstance(item, ImuBatch):
            times.append(item.times_ns)
            samples.append(item.accel_gyro)
        elif isinstance(item, CameraImage):
            stamps[item.camera].append(item.stamp_ns)
            pixels[item.camera].append(item.decode())
    arrays: dict[str, Any] = {"imu_ns": np.concatenate(times), "imu": np.concatenate(samples)}
    for camera in (0, 1):
        arrays |= {f"stamps_ns{camera}": stamps[camera], f"pixels{camera}": pixels[camera]}
    np.savez(folder / "messages.npz", cameras=2, **arrays)
    command = (
        f"rovioli {source} --vio_rosbag_end_s={SECONDS} --rovioli_run_map_builder=false "
        f"--export_estimated_poses_to_csv={folder / 'poses.csv'}"
    )
    subprocess.run([sys.executable, "-m", "maplab_py", "-c", command], check=True, timeout=600)
    return folder


def run_live(recorded: Path, folder: Path, kind: str, name: str) -> tuple[dict[str, Any], str]:
    """Play to rovioli; return what the player saw and what rovioli printed."""
    programs = {
        "player": [
            *("env", "-u", "PYTHONSAFEPATH", str(python_of(name))),
            *(PLAYERS[name], str(recorded / "messages.npz"), "--rate", str(RATE)),
        ],
        "rovioli": [
            sys.executable,
            "-m",
            "maplab_py",
            "-c",
            f"rovioli --datasource_type={kind} --sensor_calibration_file={recorded / 'sensors.yaml'} "
            f"{TOPICS} --rovioli_run_map_builder=false --live_wait_s=60 --live_silence_s=5 "
            "--live_max_delay_s=60 "
            f"--export_estimated_poses_to_csv={folder / 'poses.csv'}",
        ],
    }
    (folder / "programs.json").write_text(json.dumps(programs))
    environment = {
        **os.environ,
        "ROS_DOMAIN_ID": "11",
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_LOCALHOST_ONLY": "1",
        "ROS_IP": "127.0.0.1",
        "ROS_MASTER_URI": "http://127.0.0.1:11311",
    }
    runner = [*in_network_namespace(), sys.executable, str(NODES / "run_both.py"), str(folder)]
    subprocess.run(
        [*runner, kind], check=True, timeout=LONGEST_S + 60.0, env=environment, cwd=NODES
    )
    printed = (folder / "rovioli.out").read_text()
    return json.loads((folder / "player.out").read_text().splitlines()[-1]), printed


@pytest.mark.parametrize(
    ("kind", "name"),
    [("ros2", "jazzy"), ("ros2", "kilted"), ("ros1", "noetic"), ("foxglove", "foxglove")],
)
def test_poses_are_those_of_the_folder(
    recorded: Path, tmp_path: Path, kind: str, name: str
) -> None:
    seen, printed = run_live(recorded, tmp_path, kind, name)
    expected, poses = (
        np.loadtxt(folder / "poses.csv", delimiter=",") for folder in (recorded, tmp_path)
    )
    times, rows, live_rows = np.intersect1d(expected[:, 0], poses[:, 0], return_indices=True)
    assert len(times) >= len(expected) - 2, printed  # a reliable reader may join after the first
    error_m = np.linalg.norm(expected[rows, 1:4] - poses[live_rows, 1:4], axis=1)
    assert np.sqrt(np.mean(error_m**2)) < 1e-3, printed
    assert seen["odometry"] >= len(poses) - 2
    assert seen["frames"] == ["odom", "imu"]
