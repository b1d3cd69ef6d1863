"""optvi as a user meets it: on a recorded map, in a fresh process, on a fresh machine.

`python -m benchmarks.optvi FOLDER [REPEATS]` measures in its own process and prints JSON.
"""

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.comparison import module_output
from benchmarks.solution import effort
from tests.support.data import shared_data

_TANGO = "maplab_maps/tango_handheld"


def measure_tango(repeats: int) -> dict[str, float]:
    """Return times [s] of 10 iterations on the Tango map, from the loaded map to the new one."""
    return dict(_in_process(repeats)["warm"])


def measure_start() -> dict[str, float]:
    """Return how long the first optvi takes with no kernel compiled, and in the next process [s].

    The seconds extra are those of a process' first optvi less those of its second.
    """
    with tempfile.TemporaryDirectory() as folder:
        first, following = (_in_process(1, MAPLAB_CACHE_DIR=folder) for _ in range(2))
    return {
        "first_on_a_machine_wall_s": first["first"]["wall_s"],
        "first_on_a_machine_cpu_s": first["first"]["cpu_s"],
        "first_in_the_next_process_wall_s": following["first"]["wall_s"],
        "next_process_extra_wall_s": following["first"]["wall_s"] - following["warm"]["wall_s"],
        "next_process_extra_cpu_s": following["first"]["cpu_s"] - following["warm"]["cpu_s"],
    }


def _in_process(repeats: int, **variables: str) -> dict[str, Any]:
    folder = str(shared_data(_TANGO))
    command = ["benchmarks.optvi", folder, str(repeats)]
    return json.loads(module_output(command, **variables))


def _measure(folder: Path, repeats: int) -> dict[str, Any]:
    """Optimise the map for 10 iterations: the process' first time, then warm."""
    from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
    from maplab_py.storage.map_loading import load_map

    vi_map, _ = load_map(folder)
    options = VIOptimizationOptions(num_iterations=10, function_tolerance=0.0)
    runs = []
    for _ in range(repeats + 1):
        with effort() as spent:
            from maplab_py.algorithms.vi_optimization.optimization import optimize

            _, report = optimize(vi_map, options)
        runs.append({
            "wall_s": spent.wall_s,
            "cpu_s": spent.user_s + spent.system_s,
            "build_s": report.seconds_build,
            "solve_s": report.seconds_solve,
            "iterations": report.iterations,
        })  # fmt: skip
    return {"first": runs[0], "warm": min(runs[1:], key=lambda run: run["wall_s"])}


if __name__ == "__main__":
    print(json.dumps(_measure(Path(sys.argv[1]), int(sys.argv[2]))))
