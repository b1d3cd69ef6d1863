"""The joint stage of the city in a process of its own: `python -m benchmarks.city.joint ...`.

Runs the commands of the stage `city` of flags/city.yaml and prints a line of JSON for each: its effort, the
largest memory of the process meanwhile, and what it left in the map, against the truth.
"""

import dataclasses
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.city.sessions import read_truth
from benchmarks.places.aliased import merges_of_strangers, wrong_closures, wrong_merges
from benchmarks.solution import effort
from maplab_py.console.commands.lines import split_commands
from maplab_py.console.commands.registry import load_registry
from maplab_py.console.scripts.batch import read_stages
from maplab_py.console.session.session import Session
from maplab_py.geometry import alignment, se3
from maplab_py.pipeline.plan import MAP_TEMPLATE, RESULT_TEMPLATE, Stage
from maplab_py.report import Report
from maplab_py.sensors.yaml_text import parse_yaml
from maplab_py.simulation.truth import Truth
from maplab_py.vimap import IdIndex, VIMap

FLAGS_FILE = Path(__file__).parents[2] / "flags" / "city.yaml"
_EVALUATED = ("anchor_all_missions", "relax", "lc", "optvi")


def stage_of(name: str) -> Stage:
    """Return a stage of flags/city.yaml."""
    content: Any = parse_yaml(FLAGS_FILE.read_text(encoding="utf-8"), str(FLAGS_FILE))
    stages = read_stages(content["stages"], FLAGS_FILE)
    return next(stage for stage in stages if stage.name == name)


def run(maps: list[Path], truth: Truth, result: Path) -> None:
    """Run the stage on maps."""
    session = Session(load_registry())
    for template in stage_of("city").commands:
        line = template.replace(RESULT_TEMPLATE, str(result))
        lines = [line.replace(MAP_TEMPLATE, str(folder)) for folder in maps]
        with effort() as spent:
            report = _run_lines(session, lines if MAP_TEMPLATE in line else [line])
        name = split_commands(line)[0][0]
        figures: dict[str, Any] = {"command": name, **dataclasses.asdict(spent)}
        figures["peak_mb"] = peak_mb()
        if name in _EVALUATED:
            begin = time.process_time()
            figures |= against_truth(session.maps.selected.vi_map, truth)
            figures["evaluation_s"] = time.process_time() - begin
            print(report, file=sys.stderr, flush=True)
        print(json.dumps(figures), flush=True)


def _run_lines(session: Session, lines: list[str]) -> Report | None:
    """Run commands; drop what undo would restore, as a script does not undo."""
    report: Report | None = None
    for words in (words for line in lines for words in split_commands(line)):
        report = session.execute(session.parse(words))
        entry = session.maps.selected
        session.maps.update(dataclasses.replace(entry, past=(), future=()))
    return report


def against_truth(vi_map: VIMap, truth: Truth) -> dict[str, Any]:
    """Return sizes and errors of a map."""
    known = vi_map.baseframes.is_known[vi_map.missions.baseframe]
    mine = known[vi_map.vertices.mission]
    row = IdIndex(truth.vertex_id).rows(vi_map.vertices.id)
    p_true, p_G = truth.T_G_I[row, 4:][mine], vi_map.T_G_I[mine, 4:]
    apart = p_true - se3.transform(alignment.umeyama(p_true, p_G)[0], p_G)
    accepted, wrong = wrong_closures(vi_map, truth)
    merges, wrong_tracks = wrong_merges(vi_map, truth)
    return {
        "missions": len(known),
        "known": int(known.sum()),
        "vertices": len(vi_map.vertices),
        "observations": int(np.count_nonzero(vi_map.keypoints.landmark >= 0)),
        "ate_m": float(np.sqrt(np.mean(np.sum(apart**2, axis=1)))),
        "largest_error_m": float(np.linalg.norm(apart, axis=1).max()),
        "closures": accepted,
        "wrong_closures": wrong,
        "merges": merges,
        "wrong_merges": merges_of_strangers(vi_map, truth),
        "merges_of_mixed_tracks": wrong_tracks,
    }


def peak_mb() -> float:
    """Return the largest resident size since `effort` began."""
    text = Path("/proc/self/status").read_text(encoding="ascii")
    return next(float(s.split()[1]) for s in text.splitlines() if s.startswith("VmHWM")) / 1024.0


def main() -> None:
    """Run on the maps of `sessions`, with the truth of a folder of simulated sessions."""
    maps_folder, data, result = map(Path, sys.argv[1:4])
    maps = sorted(folder for folder in maps_folder.iterdir() if folder.is_dir())
    run(maps, read_truth(data, len(maps)), result)


if __name__ == "__main__":
    main()
