"""What is tested: under .ci/run the installed wheel and nothing of the checkout."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
from pathlib import Path

import maplab_plugins
import pytest

import maplab_py
from tests.support.coverage import NO_BROWSER, NO_DATA, not_run_here

IMPORTED_FROM = (
    "import maplab_py, maplab_plugins; print(maplab_py.__file__, maplab_plugins.__file__)"
)


@pytest.mark.skipif(
    not os.environ.get("MAPLAB_TEST_INSTALLED"), reason="only .ci/run installs the wheel"
)
def test_the_installed_packages_are_tested() -> None:
    installed = Path(sysconfig.get_path("purelib")).resolve()
    for package in (maplab_py, maplab_plugins):
        assert installed in Path(str(package.__file__)).resolve().parents
    done = subprocess.run(
        [sys.executable, "-c", IMPORTED_FROM], capture_output=True, text=True, check=True
    )
    for file in done.stdout.split():
        assert installed in Path(file).resolve().parents


def test_programs_that_tests_start_import_the_package_that_is_tested(tmp_path: Path) -> None:
    for name in ("maplab_py", "maplab_plugins"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("raise ImportError('of the working folder')\n")
    done = subprocess.run(
        [sys.executable, "-c", IMPORTED_FROM],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
    )
    assert done.stdout.split() == [maplab_py.__file__, maplab_plugins.__file__], done.stderr


def test_the_summary_counts_what_a_machine_cannot_run() -> None:
    data, browser = f"Skipped: {NO_DATA}: 'maps' is not here", f"Skipped: {NO_BROWSER}: none"
    assert not_run_here([data] * 12 + ["Skipped: one processor only"] + [browser] * 8) == (
        "not run here: 12 tests without real data, 8 without a browser"
    )
    assert not_run_here([browser]) == "not run here: 1 test without a browser"
    assert not_run_here([]) == "not run here: no test for want of real data, a browser or ROS"
