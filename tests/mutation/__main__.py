"""The command line: which faults, judged by how many processes, and the table of verdicts."""

from __future__ import annotations

import argparse
import queue
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tests.mutation.fault import Fault, FaultError
from tests.mutation.faults import AREAS
from tests.mutation.trial import Trial, Verdict


def main() -> int:
    """Judge the faults that the command line names; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutation")
    parser.add_argument("names", nargs="*", help="areas or faults; none = all faults")
    parser.add_argument("--list", action="store_true", help="only list the faults")
    parser.add_argument("--processes", type=int, default=1, help="faults judged at a time")
    parser.add_argument(
        "--seconds", type=int, default=600, help="limit of the processor time of one run of tests"
    )
    parser.add_argument(
        "--trust", action="store_true", help="do not run the tests without the fault first"
    )
    arguments = parser.parse_args()
    chosen = _chosen(arguments.names, parser)
    if arguments.list:
        for area, fault in chosen:
            print(f"{area:18} {fault.name:40} {fault.file}")
        return 0
    return _judged(chosen, arguments)


def _chosen(names: list[str], parser: argparse.ArgumentParser) -> list[tuple[str, Fault]]:
    every = [(area, fault) for area, faults in AREAS.items() for fault in faults]
    known = {*AREAS, *(fault.name for _, fault in every)}
    if unknown := [name for name in names if name not in known]:
        parser.error(f"no area or fault is called {', '.join(unknown)} (see --list)")
    return [one for one in every if not names or one[0] in names or one[1].name in names]


def _judged(chosen: list[tuple[str, Fault]], arguments: argparse.Namespace) -> int:
    counts = {"caught": 0, "survived": 0, "not judged": 0}
    with tempfile.TemporaryDirectory(prefix="maplab-mutation-") as folder:
        trials: queue.SimpleQueue[Trial] = queue.SimpleQueue()
        for number in range(arguments.processes):
            tree = Path(folder) / f"tree{number}"
            trials.put(Trial(tree, arguments.seconds, trusts_tests=arguments.trust))

        def line(one: tuple[str, Fault]) -> str:
            area, fault = one
            trial = trials.get()
            try:
                verdict, took_s, test = trial.judge(fault)
                word, detail = verdict.value, test if verdict is Verdict.CAUGHT else fault.file
            except FaultError as error:
                word, took_s, detail = "not judged", 0.0, str(error)
            finally:
                trials.put(trial)
            counts[word] += 1
            return f"{word:10} {took_s:6.1f} s  {area:18} {fault.name:40} {detail}"

        with ThreadPoolExecutor(arguments.processes) as pool:
            for text in pool.map(line, chosen):
                print(text, flush=True)
    print(", ".join(f"{count} {word}" for word, count in counts.items()))
    return 2 if counts["not judged"] else int(counts["survived"] > 0)


if __name__ == "__main__":
    sys.exit(main())
