"""Small maps, and pipelines over them."""

import hashlib
import os
from pathlib import Path

from maplab_py.pipeline import Pipeline, Stage
from maplab_py.storage.map_saving import CARD_FILE
from maplab_py.storage.native import save_map
from tests.vimap.builders import walk_map

LOAD = "load --map_folder=<CURRENT_VIMAP_FOLDER>"
SAVE = "save --map_folder=<RESULT_FOLDER>"
MERGE = "load_merge_map --map_folder=<CURRENT_VIMAP_FOLDER>"


def small_maps(folder: Path, count: int) -> tuple[Path, ...]:
    """Write maps of one mission each."""
    for number in range(count):
        save_map(walk_map(seed=number, first_ns=10**9 * (1 + 100 * number)), folder / f"m{number}")
    return tuple(folder / f"m{number}" for number in range(count))


def sessions(*commands: str) -> Stage:
    """Return a stage that edits each map."""
    return Stage("sessions", (LOAD, *commands, SAVE), each="maps")


MERGED = Stage("merged", (MERGE, SAVE), all=("sessions",))


def pipeline(maps: tuple[Path, ...], *stages: Stage) -> Pipeline:
    return Pipeline("p.yaml", maps, stages)


def contents(folder: Path) -> dict[str, str]:
    """Return the hash of every file of the results; logs, records and cards, with paths, apart."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
        and path.name != CARD_FILE
        and "tasks" not in path.relative_to(folder).parts
    }


def starts(results: Path) -> list[str]:
    """Return the tasks that were started, with repetitions, from their logs."""
    lines = (path.read_text().splitlines() for path in results.glob("tasks/*/*.log"))
    return sorted(line.split()[-1] for text in lines for line in text if " starts " in line)


def child_processes(process: int) -> list[int]:
    """Return the children of a process (Linux)."""
    folders = Path(f"/proc/{process}/task").glob("*/children")
    return [int(word) for path in folders for word in path.read_text().split()]


def is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return "State:\tZ" not in Path(f"/proc/{process}/status").read_text()
