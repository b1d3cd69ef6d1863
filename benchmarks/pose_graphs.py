"""Public and simulated pose graphs: final objective and time against GTSAM's Levenberg-Marquardt.

python -m benchmarks.pose_graphs [NAME ...] [--repeats N] [--json FILE]

Both begin at the file's poses, with the first pose fixed. The times are processor times of one
process, medians of repetitions that alternate between the two.

GTSAM runs with its own tolerances and with tighter ones; counted is the first of these runs that
ends within 1e-6 of the objective where it cannot improve any more. Reading files does not count, nor
does filling GTSAM's graph; this project's time includes all from the arrays of the file on. The last
column is the time with the default robustness over that of the plain least squares.
"""

import argparse
import dataclasses
import json
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from maplab_py.algorithms.relaxation.options import RelaxationOptions
from maplab_py.interop.g2o import PoseGraph, read_g2o, write_g2o
from tests.support.data import shared_data
from tests.support.pose_graphs import SIMULATED, optimize_graph

NAMES = ("parking-garage", "smallGrid3D", "intel", "robot_a", "robot_b", "ordered", "unordered")
_TOLERANCES = (
    1e-5,
    1e-7,
    1e-9,
    1e-11,
    0.0,
)  # relative decreases that end GTSAM; the first is its own
_MANY = 1000
_CLOSE = 1e-6
_PLAIN = RelaxationOptions(robustness="none", num_iterations=200)
_ROBUST = RelaxationOptions(num_iterations=200)


@dataclasses.dataclass(frozen=True)
class Run:
    """One solver on one graph."""

    objective: float  # sum of squared normalised errors
    iterations: int
    median_ms: float


@dataclasses.dataclass(frozen=True)
class GraphComparison:
    """This project and GTSAM on one graph."""

    name: str
    poses: int
    edges: int
    ours: Run
    theirs: Run  # as tight as it takes
    default: Run  # with GTSAM's own tolerances
    robust: Run  # ours with the default robustness
    tolerance: float  # of `theirs`
    best_objective: float  # GTSAM's, with the tightest tolerance

    @property
    def ratio(self) -> float:
        """Our time over that of GTSAM to the same objective."""
        return self.ours.median_ms / self.theirs.median_ms

    @property
    def difference(self) -> float:
        """Relative difference of our objective from GTSAM's best."""
        return (self.ours.objective - self.best_objective) / self.best_objective


def compare_graph(name: str, repeats: int) -> GraphComparison:
    """Run both on a data set of the shared data or on a simulated graph.

    The planar file is compared as GTSAM reads it, in the plane.
    """
    if name not in SIMULATED:
        return _compare_file(name, shared_data(f"g2o/{name}.g2o"), repeats)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{name}.g2o"
        write_g2o(SIMULATED[name](), path)
        return _compare_file(name, path, repeats)


def _compare_file(name: str, path: Path, repeats: int) -> GraphComparison:
    graph = read_g2o(path)
    peer = _GtsamGraph(path, is_planar="VERTEX_SE2" in path.read_text(encoding="utf-8"))
    best, _ = peer.solve(_TOLERANCES[-1])
    tolerance = next(t for t in _TOLERANCES if peer.solve(t)[0] - best <= _CLOSE * best)
    solvers: dict[str, Callable[[], tuple[float, int]]] = {
        "ours": lambda: _solve(graph, _PLAIN),
        "robust": lambda: _solve(graph, _ROBUST),
        "theirs": lambda: peer.solve(tolerance),
        "default": lambda: peer.solve(_TOLERANCES[0]),
    }
    times_ms: dict[str, list[float]] = {solver: [] for solver in solvers}
    results: dict[str, tuple[float, int]] = {}
    for repeat in range(repeats + 1):  # the first one compiles
        for solver, solve in solvers.items():
            begin = time.process_time()
            results[solver] = solve()
            if repeat > 0:
                times_ms[solver].append(1e3 * (time.process_time() - begin))
    runs = {name: Run(*results[name], statistics.median(times_ms[name])) for name in solvers}
    return GraphComparison(
        name, len(graph.id), len(graph.first), **runs, tolerance=tolerance, best_objective=best
    )


def _solve(graph: PoseGraph, options: RelaxationOptions) -> tuple[float, int]:
    result = optimize_graph(graph, options)
    return result.cost_after, result.iterations


class _GtsamGraph:
    """A graph in GTSAM's own structures."""

    def __init__(self, path: Path, *, is_planar: bool) -> None:
        import gtsam

        self._graph, self._start = gtsam.readG2o(str(path), not is_planar)
        first = min(self._start.keys())
        if is_planar:
            fixed = gtsam.NonlinearEqualityPose2(first, self._start.atPose2(first))
        else:
            fixed = gtsam.NonlinearEqualityPose3(first, self._start.atPose3(first))
        self._graph.add(fixed)

    def solve(self, tolerance: float) -> tuple[float, int]:
        """Return twice GTSAM's error at the end, and the iterations."""
        import gtsam

        parameters = gtsam.LevenbergMarquardtParams()
        if tolerance != _TOLERANCES[0]:
            parameters.setRelativeErrorTol(tolerance)
            parameters.setAbsoluteErrorTol(0.0)
            parameters.setMaxIterations(_MANY)
        optimizer = gtsam.LevenbergMarquardtOptimizer(self._graph, self._start, parameters)
        optimizer.optimize()
        return 2.0 * float(optimizer.error()), int(optimizer.iterations())


def main() -> None:
    """Compare, print a table, write JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=[*NAMES, *SIMULATED], metavar="NAME")
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    print(
        "| graph | poses | edges | objective | less GTSAM's | our ms | iterations | GTSAM ms | "
        "iterations | tolerance | ratio | GTSAM's default: ms | objective too high by | ratio | "
        "robust / plain |"
    )
    print("|---" * 15 + "|")
    results: list[dict[str, Any]] = []
    for name in arguments.names:
        c = compare_graph(name, arguments.repeats)
        too_high = (c.default.objective - c.best_objective) / c.best_objective
        print(
            f"| {name} | {c.poses} | {c.edges} | {c.ours.objective:.7g} | {c.difference:+.0e} | "
            f"{c.ours.median_ms:.1f} | {c.ours.iterations} | {c.theirs.median_ms:.1f} | "
            f"{c.theirs.iterations} | {c.tolerance:g} | **{c.ratio:.2f}** | "
            f"{c.default.median_ms:.1f} | {too_high:.0e} | "
            f"{c.ours.median_ms / c.default.median_ms:.2f} | "
            f"{c.robust.median_ms / c.ours.median_ms:.1f} |",
            flush=True,
        )
        results.append(dataclasses.asdict(c))
    if arguments.json:
        arguments.json.write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
