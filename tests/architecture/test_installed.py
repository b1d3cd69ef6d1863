"""What is tested: under .ci/run the installed wheel and nothing of the checkout."""

import os
import subprocess
import sys
import sysconfig
from pathlib import Path

import maplab_plugins
import pytest

import maplab_py
from tests.support.coverage import NO_BROWSER, NO_DATA, not_run_here
from tests.support.data import shared_data

ONLY_INSTALLED = pytest.mark.skipif(
    not os.environ.get("MAPLAB_TEST_INSTALLED"), reason="only .ci/run installs the wheel"
)
IMPORTED_FROM = (
    "import maplab_py, maplab_plugins; print(maplab_py.__file__, maplab_plugins.__file__)"
)


@ONLY_INSTALLED
def test_the_installed_packages_are_tested() -> None:
    installed = Path(sysconfig.get_path("purelib")).resolve()
    for package in (maplab_py, maplab_plugins):
        assert installed in Path(str(package.__file__)).resolve().parents
    done = subprocess.run(
        [sys.executable, "-c", IMPORTED_FROM], capture_output=True, text=True, check=True
    )
    for file in done.stdout.split():
        assert installed in Path(file).resolve().parents


@ONLY_INSTALLED
@pytest.mark.slow
@pytest.mark.parametrize("line", ["demo", "rovioli {} --save_map_folder=map; optvi; relax; lc"])
def test_the_wheel_brings_all_kernels_of_the_readme(tmp_path: Path, line: str) -> None:
    words = line.format(shared_data("euroc_mh01_10s")) if "{}" in line else line
    environment = {**os.environ, "MAPLAB_CACHE_DIR": str(tmp_path / "cache")}
    command = [sys.executable, "-m", "maplab_py", "--discard", "-c", words]
    subprocess.run(command, check=True, capture_output=True, cwd=tmp_path, env=environment)
    assert [path.name for path in (tmp_path / "cache").rglob("*.nbc")] == []


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
