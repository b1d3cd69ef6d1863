"""The worker's side: submaps are checked and optimised, each by itself, in a process that stays.

What is done to a submap is what these commands would do: load, check_map_consistency, elq,
tie_stationary_missions if wanted, optvi, save. The process stays for the next submap, because starting
Python and loading the compiled kernels takes five times as long as the work; without orders it ends after a
while.
"""

import dataclasses
import json
import logging
import os
import sys
import time
from pathlib import Path

from maplab_py.child_processes import serve
from maplab_py.errors import EstimationError, MapError, MaplabError, UserError
from maplab_py.memory import says_not_enough
from maplab_py.pipeline.messages import Ending

logger = logging.getLogger(__name__)
_FORMAT = "%(asctime)s  process %(process)d  %(message)s"


@dataclasses.dataclass(frozen=True)
class SubmapOrder:
    """A submap as a worker gets it, and what its result depends on."""

    title: str  # robot and name
    submap: Path  # folder of the submap as it came
    result: Path  # folder that gets the prepared submap, replaced as a whole
    log: Path  # file to which notes and errors are appended
    absolute_pose_gate_sigma: float  # see `VIOptimizationOptions`
    ties_stationary: bool  # whether the ends of a submap that stands still are tied
    max_rotation_rad: float  # see `StationaryOptions`
    max_translation_m: float  # likewise

    def as_line(self) -> str:
        """Return the order as a line of JSON."""
        return json.dumps(dataclasses.asdict(self), default=os.fspath) + "\n"


def prepare(order: SubmapOrder) -> str:
    """Write the prepared submap; return a line that says what was done.

    Raises:
        MapError: The submap is damaged or inconsistent.
        EstimationError: It cannot be optimised.
        UserError: The disk refuses.
    """
    from maplab_py.algorithms.landmarks.options import LandmarkQualityOptions
    from maplab_py.algorithms.landmarks.quality import evaluate_quality
    from maplab_py.algorithms.pose_graph_manipulation.edges import tie_stationary
    from maplab_py.algorithms.pose_graph_manipulation.stationary_options import StationaryOptions
    from maplab_py.algorithms.vi_optimization.optimization import optimize
    from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
    from maplab_py.storage.native import load_map, save_map
    from maplab_py.storage.resources.files import with_file_checks
    from maplab_py.vimap.consistency import check_consistency

    vi_map, _ = load_map(order.submap)
    failure = with_file_checks(check_consistency(vi_map), vi_map, order.submap).failure
    if failure:
        raise MapError(failure)
    vi_map, quality = evaluate_quality(vi_map, LandmarkQualityOptions())
    if order.ties_stationary:
        limits = StationaryOptions(order.max_rotation_rad, order.max_translation_m)
        vi_map, _ = tie_stationary(vi_map, limits)
    options = VIOptimizationOptions(
        include_absolute_pose_constraints=True,
        absolute_pose_gate_sigma=order.absolute_pose_gate_sigma,
        include_loop_closure_edges=order.ties_stationary,
        hide_iterations_console_output=True,
    )
    vi_map, report = optimize(vi_map, options)
    save_map(vi_map, order.result, force=True)
    return (
        f"{quality.good} of {quality.landmarks} landmarks good, cost {report.cost_before:.0f} to "
        f"{report.cost_after:.0f} in {report.iterations} iterations"
    )


def answer(order: SubmapOrder) -> tuple[Ending, str]:
    """Carry out an order; whatever goes wrong is in the answer: how it ended, and a line on why."""
    began = time.process_time()
    try:
        done = prepare(order)
    except MaplabError as error:
        line = " ".join(str(error).split())
        logger.error("%s: %s", order.title, line)
        if says_not_enough(line):
            return Ending.OVER_MEMORY, line
        is_refused = isinstance(error, UserError | EstimationError)
        return Ending.REFUSED if is_refused else Ending.FAILED, line
    except MemoryError:
        return Ending.OVER_MEMORY, "there is not enough memory"
    except Exception as error:  # a bug: the traceback is in the log
        logger.exception("%s", order.title)
        return Ending.FAILED, f"{type(error).__name__}: {' '.join(str(error).split())}"
    seconds = time.process_time() - began
    logger.info("%s: %s, %.2f s", order.title, done, seconds)
    return Ending.DONE, ""


def _answer_in_log(order: SubmapOrder) -> tuple[Ending, str]:
    """Carry out an order; all output, that of libraries too, goes to its log."""
    with order.log.open("ab") as log:
        os.dup2(log.fileno(), 1)
        os.dup2(log.fileno(), 2)
    return answer(order)


if __name__ == "__main__":
    logging.basicConfig(stream=sys.stderr, level=logging.INFO, format=_FORMAT)
    serve(_answer_in_log, float(sys.argv[2]))
