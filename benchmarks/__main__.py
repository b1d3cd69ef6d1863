"""Speed and memory against peers: `python -m benchmarks [what ...] [--json FILE]`.

visual: bundle adjustment against Ceres. inertial: visual-inertial against GTSAM. sessions: four
sessions in one room, conjugate gradients against Ceres' ITERATIVE_SCHUR. tango: optvi on the recorded
Tango map. start: the first optvi on a machine and in a process. See docs/benchmarks.md.
"""

import argparse
import dataclasses
import json
from pathlib import Path
from typing import Any

from benchmarks.comparison import Comparison, compare, cpu_s, scaling_exponent
from benchmarks.optvi import measure_start, measure_tango

_HEADINGS = (
    "problem", "observations", "solver", "wall s", "user s", "cpu s", "iterations", "peak MB", "cost"
)  # fmt: skip


def main() -> None:
    """Run what is asked for; print tables, write JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    everything = ("visual", "inertial", "sessions", "tango", "start")
    parser.add_argument("what", nargs="*", default=[], metavar="|".join(everything))
    parser.add_argument("--sizes", nargs="+", default=["small", "medium", "large"])
    parser.add_argument("--repeats", type=int, default=3, help="runs, of which the best counts")
    parser.add_argument("--json", type=Path, help="write all that was measured to this file")
    arguments = parser.parse_args()
    unknown = set(arguments.what) - set(everything)
    if unknown:
        parser.error(f"cannot measure {', '.join(sorted(unknown))}; choose {', '.join(everything)}")
    wanted = arguments.what or everything
    results: dict[str, Any] = {}
    for kind in ("visual", "inertial"):
        if kind in wanted:
            results[kind] = _compare_sizes(kind, arguments.sizes, arguments.repeats)
    if "sessions" in wanted:
        results["sessions"] = _compare_sizes("sessions", ["small", "room"], arguments.repeats)
    if "tango" in wanted:
        results["tango"] = _told(measure_tango(arguments.repeats))
    if "start" in wanted:
        results["start"] = _told(measure_start())
    if arguments.json:
        arguments.json.write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")


def _compare_sizes(kind: str, sizes: list[str], repeats: int) -> dict[str, Any]:
    print("| " + " | ".join(_HEADINGS) + " |")
    print("|---" * len(_HEADINGS) + "|")
    comparisons = []
    for size in sizes:
        comparisons.append(compare(kind, size, repeats))
        _print_rows(comparisons[-1])
    result: dict[str, Any] = {c.size: dataclasses.asdict(c) for c in comparisons}
    if len(comparisons) > 1:
        for solver in ("ours", "theirs"):
            exponent = scaling_exponent([getattr(c, solver) for c in comparisons])
            result[f"exponent_{solver}"] = exponent
            print(f"time per iteration of {solver} ~ observations^{exponent:.2f}")
    return result


def _print_rows(comparison: Comparison) -> None:
    for solver, m in (("maplab-py", comparison.ours), (comparison.peer, comparison.theirs)):
        cells = (
            f"{comparison.kind} {comparison.size}", str(m["observations"]), solver,
            f"{m['wall_s']:.2f}", f"{m['user_s']:.2f}", f"{cpu_s(m):.2f}", str(m["iterations"]),
            f"{m['peak_growth_mb']:.0f}", f"{m['cost']:.3f}",
        )  # fmt: skip
        print("| " + " | ".join(cells) + " |")
    cells = (
        "", "", "ratio", f"**{comparison.ratio('wall_s'):.2f}**",
        f"**{comparison.ratio('user_s'):.2f}**", f"**{comparison.cpu_ratio:.2f}**", "",
        f"**{comparison.ratio('peak_growth_mb'):.2f}**", f"{comparison.cost_difference:+.1e}",
    )  # fmt: skip
    print("| " + " | ".join(cells) + " |", flush=True)
    if abs(comparison.cost_difference) > 1e-6:
        print("**the final costs differ by more than 1e-6: the times cannot be compared**")


def _told(measured: dict[str, float]) -> dict[str, float]:
    for name, value in measured.items():
        print(f"{name.replace('_', ' ')}: {value:.2f}")
    return measured


if __name__ == "__main__":
    main()
