"""Work that does not fit into memory is refused before it begins."""

import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from maplab_py import memory
from maplab_py.console.commands.command import describe
from maplab_py.console.commands.registry import Plugin, load_registry
from maplab_py.console.scripts.runner import Runner
from maplab_py.console.session import session, status
from maplab_py.console.terminal.output import ConsoleTerminal
from maplab_py.estimation.linear.block_cholesky import BlockCholesky
from maplab_py.memory import NotEnoughMemory, available_bytes, memory_limited, require_memory
from maplab_py.plugin import CommandContext, Message
from tests.support.data import shared_data

Capture = pytest.CaptureFixture[str]


def test_a_limit_holds_inside_and_is_not_loosened_by_an_inner_call() -> None:
    require_memory(2e6, "this")
    with memory_limited(1e-3):
        require_memory(0.9e6, "this")
        with memory_limited(0.0), pytest.raises(NotEnoughMemory) as error:
            require_memory(2e6, "this")
    require_memory(2e6, "this")
    assert str(error.value).startswith("this needs 0.00 GB of memory, 0.00 GB are allowed by")
    assert all(word in str(error.value) for word in ("kfh", "--max_memory_gb"))
    with pytest.raises(NotEnoughMemory, match="are available"):
        require_memory(1e18, "this")


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs /proc")
def test_what_has_been_allocated_since_counts() -> None:
    with memory_limited(0.2):
        require_memory(0.1e9, "this")
        block = np.ones(150_000_000 // 8)
        with pytest.raises(NotEnoughMemory, match=r"beside 0\.1[45678] GB in use, 0\.20 GB are"):
            require_memory(0.1e9, "this")
        require_memory(0.01e9, "this")
    assert block.sum() == len(block)


def test_limits_of_the_process_count() -> None:
    code = (
        "import resource; from maplab_py.memory import available_bytes; before = available_bytes();"
        "resource.setrlimit(resource.RLIMIT_AS, (2**30, 2**30)); print(before, available_bytes())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    before, after = map(float, done.stdout.split())
    assert after < 2**30 < before


def test_limits_of_control_groups_count(tmp_path: Path) -> None:
    group = tmp_path / "group"
    group.mkdir()
    (group / "memory.max").write_text("1000000\n")
    (group / "memory.current").write_text("700000\n")
    (group / "memory.stat").write_text("anon 500000\ninactive_file 100000\n")
    left = memory._left_in_group(group, "memory.max", "memory.current")
    assert left == 1000000 - (700000 - 100000)
    (group / "memory.max").write_text("max\n")
    assert memory._left_in_group(group, "memory.max", "memory.current") == float("inf")
    assert 0.0 < available_bytes() < float("inf")


def test_a_factor_that_does_not_fit_is_refused_before_it_is_allocated() -> None:
    nodes = 600
    rows, cols = np.tril_indices(nodes)
    dense_bytes = 8 * (3 * nodes) ** 2 / 2
    with (
        memory_limited(0.9 * dense_bytes * 1e-9),
        pytest.raises(NotEnoughMemory, match="1800 unknowns"),
    ):
        BlockCholesky(rows, cols, nodes, 3)
    with memory_limited(10 * dense_bytes * 1e-9):
        assert BlockCholesky(rows, cols, nodes, 3).statistics.nonzeros > 0


LINES = ("optvi", "lc", "relax", "lsparsify --num_landmarks_to_keep=3000")


@pytest.mark.parametrize("line", LINES)
def test_commands_refuse_in_one_line(capsys: Capture, line: str) -> None:
    terminal = ConsoleTerminal()
    runner = Runner(session.Session(load_registry(), terminal), terminal)
    assert runner.run_text(f"load {shared_data('maplab_maps/tango_handheld')}") == status.Status.OK
    before = runner.session.maps.state
    capsys.readouterr()
    assert runner.run_text(f"{line} --max_memory_gb=0.01") == status.Status.USER_ERROR
    _, err = capsys.readouterr()
    (message,) = err.splitlines()
    assert "0.01 GB are allowed by --max_memory_gb" in message
    assert runner.session.maps.state is before
    assert runner.run_text(f"{line} --max_memory_gb=much") == status.Status.USER_ERROR
    assert "must be a number of gigabytes" in capsys.readouterr().err


def test_running_out_of_memory_is_no_error_of_the_program(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """What a command cannot foresee fails in one line too."""

    def greedy(context: CommandContext) -> Message:
        """Ask for an exbibyte."""
        return Message(str(np.empty(2**60, dtype=np.uint8)[0]))

    terminal = ConsoleTerminal()
    runner = Runner(session.Session(load_registry(), terminal), terminal)
    runner.session.registry.add(describe(greedy, "greedy", (), needs_map=False), Plugin("greedy"))
    assert runner.run_text("greedy") == status.Status.FAILED
    (line,) = capsys.readouterr().err.splitlines()
    assert "there is not enough memory" in line
    assert "an error of the program" not in line


def test_a_map_that_does_not_fit_is_refused(tmp_path: Path) -> None:
    """Give the whole process twenty megabytes."""
    code = (
        "import resource, sys; from maplab_py.console.main import main;"
        "import maplab_py.storage.native, maplab_py.algorithms.vi_optimization.optimization;"
        "import numpy as np;"
        "from maplab_py.memory import _kilobytes; from pathlib import Path;"
        "used = int(_kilobytes(Path('/proc/self/status'), 'VmSize:'));"
        "resource.setrlimit(resource.RLIMIT_AS, (used + 20_000_000, used + 20_000_000));"
        "sys.exit(main(sys.argv[1:]))"
    )
    folder = shared_data("maplab_maps/tango_handheld")
    done = subprocess.run(
        [sys.executable, "-c", code, "-c", f"load {folder}"],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
    )
    assert done.returncode == status.Status.USER_ERROR
    (line,) = [each for each in done.stderr.splitlines() if each.startswith("error")]
    assert f"{folder}: does not fit into memory" in line
    assert "an error of the program" not in line
    assert "Traceback" not in done.stderr
    assert resource.RLIM_INFINITY < 0
