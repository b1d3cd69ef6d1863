"""Runs the player and rovioli (and a ROS 1 master) at the same time, where only the loopback is."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

LONGEST_S = 240.0


def main() -> None:
    folder, kind = Path(sys.argv[1]), sys.argv[2]
    programs = json.loads((folder / "programs.json").read_text())
    if kind == "ros1":
        programs = {"master": ["rosmaster", "--core", "-p", "11311"], **programs}
    started: dict[str, subprocess.Popen[bytes]] = {}
    deadline_s = time.monotonic() + LONGEST_S
    try:
        for name, command in programs.items():
            with (folder / f"{name}.out").open("wb") as output:
                started[name] = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT)
            if name == "master":
                time.sleep(3.0)
        for name in ("player", "rovioli"):
            started[name].wait(max(deadline_s - time.monotonic(), 0.1))
    finally:
        for process in started.values():
            process.kill()
    if started["player"].returncode or started["rovioli"].returncode:
        sys.exit("\n".join((folder / f"{name}.out").read_text() for name in programs))


if __name__ == "__main__":
    main()
