"""Real robots beside rovioli: a node plays a recording, rovioli maps it, and both say what they saw."""

import dataclasses
import json
import os
import shlex
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.interop.recordings import protocol, reader_choice
from tests.interop.live.environments import in_network_namespace, python_of
from tests.interop.recordings.written import write_calibration

NODES = Path(__file__).parent / "nodes"
PLAYERS = {
    "jazzy": ("ros2", "ros2_player.py"),
    "kilted": ("ros2", "ros2_player.py"),
    "noetic": ("ros1", "ros1_player.py"),
    "foxglove": ("foxglove", "foxglove_player.py"),
}
"""Transport and program of each robot."""
MASTER = "rosmaster --core -p 11311"
_ENVIRONMENT = {
    "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    "ROS_LOCALHOST_ONLY": "1",
    "ROS_IP": "127.0.0.1",
    "ROS_MASTER_URI": "http://127.0.0.1:11311",
}


@dataclasses.dataclass(frozen=True)
class LiveRun:
    """A run of rovioli beside a robot."""

    folder: Path  # of what the programs have written
    seen: dict[str, Any]  # by the last player; empty if rovioli failed
    printed: str  # by rovioli
    status: int  # of rovioli
    processor_s: float
    memory_mb: list[tuple[float, float]]  # seconds, MB

    @property
    def report(self) -> dict[str, Any]:
        """The report of rovioli."""
        return last_report(self.printed)


def last_report(printed: str) -> dict[str, Any]:
    """Return the report of the last command that `maplab` ran."""
    lines = [line for line in printed.splitlines() if line.startswith("{")]
    assert lines, printed
    return dict(json.loads(lines[-1])["report"])


def write_messages(
    source: Path, folder: Path, *, seconds: float = 0.0, cameras: Sequence[int] = (0, 1)
) -> protocol.RecordedSensors:
    """Write what a robot is to send (messages.npz) and its calibration (sensors.yaml).

    Args:
        source: Folder of EuRoC.
        folder: Gets the files.
        seconds: Length of the part; 0 = all.
        cameras: Those that are played.
    """
    recording = reader_choice.open_recording(source)
    write_calibration(recording.device, folder / "sensors.yaml")
    end_ns = recording.start_ns + round(seconds * 1e9) if seconds else None
    times, samples = [], []
    images: dict[int, list[tuple[int, Any]]] = {camera: [] for camera in cameras}
    for item in recording.items(None, end_ns):
        if isinstance(item, protocol.ImuBatch):
            times.append(item.times_ns)
            samples.append(item.accel_gyro)
        elif isinstance(item, protocol.CameraImage) and item.camera in images:
            images[item.camera].append((item.stamp_ns, item.decode()))
    arrays: dict[str, Any] = {"imu_ns": np.concatenate(times), "imu": np.concatenate(samples)}
    for camera, stamped in images.items():
        stamps_ns, pixels = zip(*stamped, strict=True)
        arrays |= {f"stamps_ns{camera}": stamps_ns, f"pixels{camera}": pixels}
    np.savez(folder / "messages.npz", **arrays)
    return recording.device


def maplab(command: str) -> list[str]:
    """Return the program that runs a command and prints its report as JSON."""
    return [sys.executable, "-m", "maplab_py", "--json", "--discard", "-c", command]


def run_live(
    folder: Path,
    robot: str,
    recorded: Path,
    flags: str,
    *players: str,
    master: str = MASTER,
    domain: int = 11,
    cameras: int = 2,
    longest_s: float = 240.0,
) -> LiveRun:
    """Let a robot play to rovioli; return what both saw.

    Args:
        folder: Gets what the programs print.
        robot: One of `PLAYERS`.
        recorded: Folder of `write_messages`.
        flags: Of rovioli, beside its source.
        players: Options of the players that run one after the other.
        master: Shell command of the master of ROS 1.
        domain: Of ROS 2.
        cameras: Number of cameras.
        longest_s: The programs are killed then.
    """
    kind, program = PLAYERS[robot]
    start = ["env", "-u", "PYTHONSAFEPATH", "-u", "PYTHONPATH", str(python_of(robot)), program]
    start += [str(recorded / "messages.npz"), "--cameras", str(cameras)]
    commands = [f"{shlex.join(start)} {options}" for options in players or ("",)]
    if kind == "ros1":
        commands.insert(0, "sleep 3")  # the master starts
    topics = ",".join(f"/cam{camera}/image_raw" for camera in range(cameras))
    rovioli = (
        f"rovioli --datasource_type={kind} --sensor_calibration_file={recorded / 'sensors.yaml'} "
        f"--camera_topics={topics} --imu_topic=/imu0 --live_wait_s=60 --live_silence_s=5 {flags}"
    )
    programs = {"master": ["sh", "-c", master]} if kind == "ros1" else {}
    programs |= {"player": ["sh", "-c", "; ".join(commands)], "rovioli": maplab(rovioli)}
    (folder / "programs.json").write_text(json.dumps(programs))
    runner = [*in_network_namespace(), sys.executable, str(NODES / "run_together.py"), str(folder)]
    subprocess.run(
        [*runner, str(longest_s)],
        check=True,
        timeout=longest_s + 60.0,
        env={**os.environ, **_ENVIRONMENT, "ROS_DOMAIN_ID": str(domain)},
        cwd=NODES,
    )
    usage = json.loads((folder / "usage.json").read_text())
    printed = (folder / "rovioli.out").read_text()
    played = (folder / "player.out").read_text().splitlines()
    status = usage["codes"].get("rovioli", -1)
    assert status > 0 or "".join(played[-1:]).startswith("{"), "\n".join([*played, printed])
    return LiveRun(
        folder,
        {} if status > 0 else json.loads(played[-1]),
        printed,
        status,
        usage["processor_s"],
        [tuple(sample) for sample in usage["memory_mb"]],
    )
