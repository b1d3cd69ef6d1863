"""A copy of the tree in which faults are planted one after the other."""

import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from enum import Enum
from pathlib import Path

from tests.mutation.fault import Fault, FaultError, planted
from tests.support.data import REPOSITORY, shared_data_folder

_LEFT_OUT = shutil.ignore_patterns(
    ".git", ".venv", "venv", "site", "build", "dist", ".*_cache", ".hypothesis", "*.pyc"
)
_SOME_FAILED, _OUT_OF_TIME = 1, -signal.SIGXCPU


class Verdict(Enum):
    """What became of a fault."""

    CAUGHT = "caught"
    SURVIVED = "survived"


class Trial:
    """One copy of the tree; use one per process that works at the same time."""

    def __init__(self, folder: Path, seconds: int, *, trusts_tests: bool) -> None:
        """Copy the tree.

        Args:
            folder: Where the copy goes; must not exist.
            seconds: Processor time of the tests at which a fault counts as caught.
            trusts_tests: Do not run the tests without the fault first.
        """
        self._root, self._seconds, self._trusts_tests = folder, seconds, trusts_tests
        shutil.copytree(REPOSITORY, folder, ignore=_LEFT_OUT)
        self._passing: set[tuple[str, ...]] = set()

    def judge(self, fault: Fault) -> tuple[Verdict, float, str]:
        """Plant a fault, run its tests, and take it out again.

        Returns:
            The verdict, the seconds that the tests took, and the first test that failed.

        Raises:
            FaultError: It cannot be planted, or its tests fail or do not run without it.
        """
        path = self._root / fault.file
        source = path.read_text(encoding="utf-8")
        faulty = planted(fault, source)
        self._check_without(fault)
        before = path.stat()
        path.write_text(faulty, encoding="utf-8")
        began = time.perf_counter()
        try:
            code, output = self._run(fault.selection)
        finally:
            path.write_text(source, encoding="utf-8")
            os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
        seconds = time.perf_counter() - began
        if code == _OUT_OF_TIME:
            return Verdict.CAUGHT, seconds, f"no end after {self._seconds} s of processor time"
        if code not in (0, _SOME_FAILED):
            raise FaultError(f"pytest ended with status {code}: {_last_line(output)}")
        return (Verdict.CAUGHT if code else Verdict.SURVIVED), seconds, _first_failure(output)

    def _check_without(self, fault: Fault) -> None:
        if self._trusts_tests or fault.selection in self._passing:
            return
        code, output = self._run(fault.selection)
        if code:
            found = _first_failure(output) or _last_line(output)
            raise FaultError(f"its tests do not pass without it: {found}")
        self._passing.add(fault.selection)

    def _run(self, selection: tuple[str, ...]) -> tuple[int, str]:
        command = [
            sys.executable,
            "-m",
            "pytest",
            "-x",
            "-q",
            "-rfE",
            "-n0",
            "-p",
            "no:cacheprovider",
        ]
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join([str(self._root), str(self._root / "plugins")]),
            "PYTHONDONTWRITEBYTECODE": "1",
            "MAPLAB_SHARED_DATA": str(shared_data_folder()),
        }
        done = subprocess.run(
            [*command, *selection],
            cwd=self._root,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
            preexec_fn=self._limit_time,
        )
        return done.returncode, done.stdout + done.stderr

    def _limit_time(self) -> None:
        resource.setrlimit(resource.RLIMIT_CPU, (self._seconds, self._seconds + 5))


def _first_failure(output: str) -> str:
    lines = (
        line for line in output.splitlines() if line.startswith(("FAILED tests", "ERROR tests"))
    )
    return next((line.split(" - ")[0].split(" ", 1)[1] for line in lines), "")


def _last_line(output: str) -> str:
    return (output.strip().splitlines() or ["no output"])[-1]
