"""Runs the programs of a folder at the same time where only the loopback is, and measures rovioli."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

SAMPLE_S = 1.0


def main() -> None:
    folder, longest_s = Path(sys.argv[1]), float(sys.argv[2])
    programs = json.loads((folder / "programs.json").read_text())
    started: dict[str, subprocess.Popen[bytes]] = {}
    begin_s = time.monotonic()
    memory_mb: list[tuple[float, float]] = []
    codes: dict[str, int] = {}
    processor_s = 0.0
    try:
        for name, command in programs.items():
            with (folder / f"{name}.out").open("wb") as output:
                started[name] = subprocess.Popen(
                    command, stdout=output, stderr=subprocess.STDOUT, start_new_session=True
                )
        waited = {started[name].pid: name for name in ("player", "rovioli") if name in started}
        # nobody plays on to a program that has failed
        while waited and not codes.get("rovioli") and time.monotonic() - begin_s < longest_s:
            for pid, name in list(waited.items()):
                done, status, usage = os.wait4(pid, os.WNOHANG)
                if done:
                    codes[waited.pop(pid)] = os.waitstatus_to_exitcode(status)
                    if name == "rovioli":
                        processor_s = usage.ru_utime + usage.ru_stime
                elif name == "rovioli":
                    memory_mb.append((time.monotonic() - begin_s, memory_of(pid)))
            time.sleep(SAMPLE_S)
    finally:
        for process in started.values():
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
    usage = {"codes": codes, "processor_s": processor_s, "memory_mb": memory_mb}
    (folder / "usage.json").write_text(json.dumps(usage))


def memory_of(pid: int) -> float:
    """Return the resident memory of a process in MB."""
    try:
        status = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return 0.0
    kilobytes = [line.split()[1] for line in status.splitlines() if line.startswith("VmRSS")]
    return float(kilobytes[0]) * 1e-3 if kilobytes else 0.0


if __name__ == "__main__":
    main()
