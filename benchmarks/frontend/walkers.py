"""Odometry in a room where people walk: `python -m benchmarks.frontend.walkers FOLDER [SEED ...]`.

A session of 16 s is rendered twice: with three people, who cover some 28 % of the images of half of it, and
without. Errors [mm] are those of the recorded map, before and after its optimisation.
"""

import argparse
import dataclasses
import sys
from pathlib import Path

from benchmarks.frontend.sequences import run
from maplab_py.simulation import raw_data, scenario_file
from maplab_py.simulation.scenario import SessionImages

_SECONDS = 16.0
_WALKERS = SessionImages(walkers=3, walkers_from_s=0.35 * _SECONDS, walkers_until_s=0.85 * _SECONDS)


def rendered(folder: Path, seed: int) -> tuple[Path, Path]:
    """Return the recordings without and with people; rendered unless they are there."""
    scenario = scenario_file.load_scenario("stereo_room").with_seed(seed)
    session = dataclasses.replace(scenario.sessions[0], duration_s=_SECONDS, turns=0.9)
    folders = []
    for name, images in (("empty", SessionImages()), ("walkers", _WALKERS)):
        target = folder / f"{name}_{seed}"
        sessions = (dataclasses.replace(session, images=images),)
        if not target.exists():
            raw_data.write_maps(
                dataclasses.replace(scenario, sessions=sessions), target, raw_data=True
            )
        folders.append(target / "raw" / "session_1")
    return folders[0], folders[1]


def main() -> None:
    """Print a line for each seed and number of cameras."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("seeds", type=int, nargs="*", default=[1, 2])
    arguments = parser.parse_args()
    for seed in arguments.seeds:
        folders = rendered(arguments.folder, seed)
        for cameras in ("", "0"):
            empty, crowded = (run(folder, cameras) for folder in folders)
            sys.stdout.write(
                f"seed {seed}, {empty.cameras} cameras: empty {1e3 * empty.ate_final_m:.2f}, walkers "
                f"{1e3 * crowded.ate_final_m:.2f}, optimised {1e3 * empty.optvi_ate_m:.2f}, "
                f"{1e3 * crowded.optvi_ate_m:.2f}\n"
            )
            sys.stdout.flush()


if __name__ == "__main__":
    main()
