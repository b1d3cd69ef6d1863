"""Old or new, never neither, and nothing left behind, whatever call of a save fails or is the last."""

import json
import os
import subprocess
import sys

import pytest

from tests.faults.scenarios import SCENARIOS
from tests.support import data, programs

QUICK = ("csv", "files of one command", "segment database", "summary map", "aliases", "history")
"""Scenarios of a few seconds; those of maps have hundreds of faults."""

NAMES = [pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in SCENARIOS]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs fork, flock and /proc")
@pytest.mark.parametrize("name", NAMES)
def test_every_system_call_may_fail_or_be_the_last(name: str) -> None:
    done = subprocess.run(
        [*programs.module_of_tests("tests.faults"), name],
        cwd=data.REPOSITORY,
        env={**os.environ, "MPLBACKEND": "Agg"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["broken"] == []
    assert result["injected"] > 3 * len(result["calls"]) / 2
