"""Place recognition against brute force and truth; see docs/benchmarks.md.

python -m benchmarks.places WHAT [SEED ...] [--json FILE]
"""

import argparse
import dataclasses
import itertools
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from tests.support.machine import slowness

_WHAT = {
    "aliased": "rooms that look alike, by seeds",
    "alike": "two rooms that look alike and a corridor: sessions that visit both or one, by seeds",
    "scrambled": "EuRoC submaps in scrambled base frames, by seeds",
    "pairs": "frame pairs of the handheld walk's loop, against an exhaustive search",
    "gap": "what is left of that loop after optvi, relax, lc, optvi",
    "euroc": "closures of the EuRoC submaps, against truth and an exhaustive search",
    "sessions": "precision and recall of closures of four simulated sessions, by seeds",
    "long": "time of lc for four simulated sessions of two minutes, by seeds",
    "ambiguity": "what --lc_max_ambiguous_ratio is compared with, by seeds",
    "walk": "time of lc for the handheld walk",
}


def main() -> None:
    """Measure what is asked for; print one line each, append them to a JSON-lines file."""
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="; ".join(f"{name}: {text}" for name, text in _WHAT.items()),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("what", choices=list(_WHAT))
    parser.add_argument("seeds", nargs="*", type=int, default=[1])
    parser.add_argument("--json", type=Path, help="append what was measured to this file")
    arguments = parser.parse_args()
    begin = time.process_time()
    for figures in _measure(arguments.what, arguments.seeds):
        row = dataclasses.asdict(figures)
        row["processor_s"] = round(time.process_time() - begin, 1)
        row["slowness"] = round(slowness(), 2)
        print("  ".join(f"{name}={_short(value)}" for name, value in row.items()), flush=True)
        if arguments.json:
            with arguments.json.open("a", encoding="utf-8") as file:
                file.write(json.dumps({"what": arguments.what, **row}) + "\n")
        begin = time.process_time()


def _measure(what: str, seeds: list[int]) -> Iterator[Any]:
    from benchmarks.places import aliased, alike, ambiguity, euroc, scrambled, simulated, tango

    whole: dict[str, Callable[[], Iterator[Any]]] = {
        "pairs": tango.measure_pairs,
        "gap": tango.measure_gap,
        "walk": tango.measure_time,
        "euroc": euroc.measure,
    }
    if what in whole:
        return whole[what]()
    if what == "scrambled":
        return scrambled.measure(seeds)
    by_seed = {
        "alike": alike.measure,
        "sessions": simulated.measure,
        "ambiguity": ambiguity.measure,
    }
    if what in by_seed:
        return itertools.chain.from_iterable(by_seed[what](seed) for seed in seeds)
    return map(simulated.measure_long if what == "long" else aliased.measure, seeds)


def _short(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{name}={_short(each)}" for name, each in value.items()) + "}"
    if isinstance(value, tuple | list):
        return "(" + ", ".join(map(_short, value)) + ")"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    main()
