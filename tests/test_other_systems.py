"""Maps are optimised and saved where parts of Linux are missing: those of macOS, then those of Windows."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.data import shared_data

PROGRAM = """
import builtins, io, os, signal, sys, types
from maplab_py.console import main  # the libraries are those of this system
from maplab_py import warmup

for module in {modules}:
    for name in [each for each in sys.modules if each.startswith("maplab_")]:
        del sys.modules[name]  # to be imported again without it
    sys.modules[module] = None
for module, names in ((os, {functions}), (signal, {signals})):
    for name in names:
        delattr(module, name)
opened = io.open

def open_elsewhere(file, *arguments, **settings):
    if str(file).startswith(("/proc/self/cgroup", "/proc/self/status", "/proc/meminfo", "/sys")):
        raise FileNotFoundError(file)
    return opened(file, *arguments, **settings)

builtins.open = io.open = open_elsewhere
from maplab_py.atomic import system
system.ctypes = types.SimpleNamespace(CDLL=lambda *_, **__: object())  # without renameat2
from maplab_py.console.main import main
sys.exit(main(sys.argv[1:]))
"""
MACOS: tuple[list[str], list[str], list[str]] = ([], ["sched_getaffinity"], [])
WINDOWS = (
    ["fcntl", "resource", "termios", "pwd", "grp"],
    ["sched_getaffinity", "geteuid", "killpg", "getpgrp", "O_DIRECTORY", "O_NOFOLLOW", "O_CLOEXEC"],
    ["SIGPIPE", "SIGKILL", "SIGALRM", "SIGHUP", "SIGWINCH"],
)


@pytest.mark.parametrize("missing", [MACOS, WINDOWS], ids=["macOS", "Windows"])
def test_a_map_is_optimised_and_saved_without(
    missing: tuple[list[str], list[str], list[str]], tmp_path: Path
) -> None:
    modules, functions, signals = missing
    shown = shared_data("maplab_maps/euroc_v1_01/euroc_v1_01_submap_0")
    saves = "save --map_folder=a; save --map_folder=a --overwrite"
    program = PROGRAM.format(modules=modules, functions=functions, signals=signals)
    environment = {
        **os.environ,
        "NUMBA_THREADING_LAYER": "workqueue",
        "XDG_STATE_HOME": str(tmp_path / "state"),
        "XDG_CONFIG_HOME": str(tmp_path / "config"),
    }
    for line in (
        f"load {shown}; optvi --ba_num_iterations=2; {saves}",
        "load a; check_map_consistency",
    ):
        done = subprocess.run(
            [sys.executable, "-c", program, "-c", line],
            env=environment,
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
    assert "consistent" in done.stdout
