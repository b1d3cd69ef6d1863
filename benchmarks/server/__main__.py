"""Figures of the map server: `python -m benchmarks.server [growth|euroc|kills|throughput] [--small]`.

growth: processor time per new submap with 10 to 100 missions. euroc: EuRoC's eight submaps as one robot
and as two. kills: four robots, forty submaps, a server that is killed twenty times. throughput: processor
time of a submap by stage; `--maps FOLDER` takes maps of robots instead of simulated ones.
"""

import argparse
from pathlib import Path

from benchmarks.server.euroc import measure_euroc
from benchmarks.server.growth import measure_growth
from benchmarks.server.kills import measure_kills
from benchmarks.server.throughput import measure_throughput


def main() -> None:
    """Run what is asked for, and print it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", nargs="*", default=[], metavar="growth|euroc|kills|throughput")
    parser.add_argument("--small", action="store_true", help="a quarter of missions and kills")
    parser.add_argument("--maps", type=Path, help="maps of robots, with their trajectories")
    arguments = parser.parse_args()
    wanted = arguments.what or ["growth", "euroc", "kills", "throughput"]
    if "growth" in wanted:
        for line in measure_growth(25 if arguments.small else 100):
            print(line, flush=True)
    if "euroc" in wanted:
        for robots in (1, 2):
            print(measure_euroc(robots), flush=True)
    if "kills" in wanted:
        print(measure_kills(kills=5 if arguments.small else 20), flush=True)
    if "throughput" in wanted:
        for line in measure_throughput(arguments.maps):
            print(line, flush=True)


if __name__ == "__main__":
    main()
